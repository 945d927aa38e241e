"""Robot messages of the primary port: the type and the body of each, after their common header."""

import struct

from weldcal.tools.emulators.ur.controller.events import (
    ErrorCode,
    Event,
    Popup,
    SafetyChanged,
    ScriptStopped,
    Started,
    Text,
)

TEXT, POPUP, SAFETY_MODE, ERROR_CODE, KEY, RUNTIME_EXCEPTION = 0, 2, 5, 6, 7, 10
LONGEST_TITLE = 255


def message_body(event: Event) -> tuple[int, bytes]:
    """What the guide of the client interface lays down for this event."""
    match event:
        case Text(text=text):
            return TEXT, text.encode()
        case Popup():
            flags = struct.pack(">IB3?", 0, 0, event.warning, event.error, event.blocking)
            return POPUP, flags + _titled(event.title) + event.text.encode()
        case ScriptStopped():
            return RUNTIME_EXCEPTION, struct.pack(">ii", event.line, event.column) + event.text.encode()
        case ErrorCode():
            numbers = struct.pack(">3i2I", event.code, event.argument, event.level, 0, 0)
            return ERROR_CODE, numbers + event.text.encode()
        case SafetyChanged(mode=mode):
            return SAFETY_MODE, struct.pack(">2iB2I", 0, 0, mode, 0, 0)
        case _:
            title = "PROGRAM_XXX_STARTED" if isinstance(event, Started) else "PROGRAM_XXX_STOPPED"
            return KEY, struct.pack(">2i", 0, 0) + _titled(title) + event.text.encode()


def _titled(title: str) -> bytes:
    text = title.encode()[:LONGEST_TITLE]
    return bytes([len(text)]) + text
