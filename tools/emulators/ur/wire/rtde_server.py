"""RTDE server on port 30004: recipes, claims, and packages at an integer share of 500 Hz (protocols 1 and 2)."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from weldcal.tools.emulators.ur.controller.core import Controller
from weldcal.tools.emulators.ur.wire.net import Connection, Server
from weldcal.tools.emulators.ur.wire.rtde_fields import (
    CODES,
    MASKED,
    Getter,
    Input,
    Output,
    apply_masked,
    inputs,
    outputs,
)

PROTOCOL, VERSION, TEXT, DATA, SET_OUTPUTS, SET_INPUTS, START, PAUSE = (ord(letter) for letter in "VvMUOISP")
FREQUENCY_HZ = 500.0
WARNING = 2


@dataclass
class OutputRecipe:
    """What a client asked for, ready to pack; vectors and scalars alternate as the recipe orders them."""

    number: int
    every: int
    packer: struct.Struct
    getters: tuple[tuple[Getter, bool], ...]
    at: dict[str, int]  # index of each real output's first number in a package


@dataclass
class InputRecipe:
    """What a client will write, ready to unpack."""

    names: tuple[str, ...]
    packer: struct.Struct
    fields: tuple[tuple[str, Input, int], ...]
    masked: bool


@dataclass
class Session:
    """One client's state."""

    protocol: int = 1
    started: bool = False
    output: OutputRecipe | None = None
    recipes: dict[int, InputRecipe] = field(default_factory=dict)
    counter: int = 0


class RtdeServer(Server):
    """The protocol; `on_input` hears of every input package: its connection, its recipe, when."""

    kind = "rtde"

    def __init__(self, controller: Controller, on_input: Callable[[Connection, int, float], None]) -> None:
        self._controller = controller
        self._on_input = on_input
        self._sessions: dict[Connection, Session] = {}
        version = controller.version
        self._outputs = {name: f for name, f in outputs().items() if version.at_least(*f.since)}
        self._inputs = inputs()
        self._claims: dict[str, Connection | None] = {}
        self.wrong: dict[str, float] = {}  # injected: the first number that is reported of each of these outputs

    def real_outputs(self) -> list[str]:
        """Names of the outputs of real numbers."""
        return [name for name, f in self._outputs.items() if CODES[f.type].endswith("d")]

    def claim_elsewhere(self, names: list[str]) -> None:
        """Another user of the controller (EtherNet/IP, PROFINET) takes these inputs; unknown names are ignored."""
        for name in names:
            if name in self._inputs:
                self._claims[name] = None

    def release_elsewhere(self) -> None:
        """That user lets go."""
        self._claims = {name: owner for name, owner in self._claims.items() if owner is not None}

    def opened(self, connection: Connection, now: float) -> None:
        self._sessions[connection] = Session()

    def gone(self, connection: Connection) -> None:
        self._sessions.pop(connection, None)
        self._claims = {name: owner for name, owner in self._claims.items() if owner is not connection}

    def arrived(self, connection: Connection, data: bytes, now: float) -> None:
        connection.inbox += data
        inbox = connection.inbox
        while len(inbox) >= 3:
            size, kind = struct.unpack_from(">HB", inbox)
            if size < 3:
                connection.close(reset=False)
                return
            if len(inbox) < size:
                return
            payload = bytes(inbox[3:size])
            del inbox[:size]
            try:
                self._handle(connection, self._sessions[connection], kind, payload, now)
            except (struct.error, UnicodeDecodeError):
                self._say(connection, f"A package of type {chr(kind)!r} has the wrong size.", now)

    def _handle(self, connection: Connection, session: Session, kind: int, payload: bytes, now: float) -> None:
        if kind == DATA:
            self._data(connection, session, payload, now)
        elif kind == PROTOCOL:
            (wanted,) = struct.unpack(">H", payload)
            accepted = wanted in (1, 2)
            session.protocol = wanted if accepted else session.protocol
            self._reply(connection, kind, bytes([accepted]), now)
        elif kind == VERSION:
            v = self._controller.version
            self._reply(connection, kind, struct.pack(">4I", v.major, v.minor, v.bugfix, v.build), now)
        elif kind == SET_OUTPUTS:
            self._reply(connection, kind, self._set_outputs(session, payload), now)
        elif kind == SET_INPUTS:
            self._reply(connection, kind, self._set_inputs(connection, session, payload), now)
        elif kind == START:
            session.started = session.output is not None
            self._reply(connection, kind, bytes([session.started]), now)
        elif kind == PAUSE:
            session.started = False
            self._reply(connection, kind, b"\x01", now)
        elif kind != TEXT:
            self._say(connection, f"Package type {kind} is unknown.", now)

    def _set_outputs(self, session: Session, payload: bytes) -> bytes:
        frequency = 125.0
        if session.protocol >= 2:
            (frequency,) = struct.unpack_from(">d", payload)
            payload = payload[8:]
        names = _names(payload)
        known = [self._outputs.get(name) for name in names]
        types = ",".join("NOT_FOUND" if f is None else f.type for f in known).encode()
        found = [f for f in known if f is not None]
        good = bool(names) and len(found) == len(names)
        good &= 0.0 < frequency <= FREQUENCY_HZ
        session.output = self._output_recipe(frequency, names, found, session.protocol) if good else None
        number = bytes([1 if session.output is not None else 0])
        return types if session.protocol < 2 else number + types

    def _output_recipe(
        self, frequency: float, names: Sequence[str], fields: Sequence[Output], protocol: int
    ) -> OutputRecipe:
        code = ">HB" + ("B" if protocol >= 2 else "") + "".join(CODES[f.type] for f in fields)
        getters = tuple((f.get, f.type.startswith("VECTOR")) for f in fields)
        at, start = {}, 3 if protocol >= 2 else 2
        for name, f in zip(names, fields, strict=True):
            if CODES[f.type].endswith("d"):
                at[name] = start
            start += int(CODES[f.type][:-1] or 1)
        return OutputRecipe(1, max(1, round(FREQUENCY_HZ / frequency)), struct.Struct(code), getters, at)

    def _set_inputs(self, connection: Connection, session: Session, payload: bytes) -> bytes:
        names = _names(payload)
        types = [self._input_type(name, connection) for name in names]
        good = bool(names) and not {"NOT_FOUND", "IN_USE"} & set(types)
        number = 0
        if good:
            session.counter += 1
            number = session.counter
            session.recipes[number] = self._input_recipe(names)
            self._claims |= dict.fromkeys(names, connection)
        return bytes([number]) + ",".join(types).encode()

    def _input_type(self, name: str, connection: Connection) -> str:
        if name not in self._inputs:
            return "NOT_FOUND"
        return self._inputs[name].type if self._claims.get(name, connection) is connection else "IN_USE"

    def _input_recipe(self, names: list[str]) -> InputRecipe:
        fields: list[tuple[str, Input, int]] = []
        code = ">"
        for name in names:
            kind = self._inputs[name].type
            code += CODES[kind]
            fields.append((name, self._inputs[name], {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6}.get(kind, 1)))
        return InputRecipe(tuple(names), struct.Struct(code), tuple(fields), bool(set(names) & set(MASKED)))

    def _data(self, connection: Connection, session: Session, payload: bytes, now: float) -> None:
        recipe = session.recipes.get(payload[0]) if payload else None
        # [M] too long is read as far as the recipe goes: ur_rtde's getForwardKinematics(q, tcp) sends 12 numbers in a
        # recipe of 6, and its users get an answer
        if recipe is None or len(payload) - 1 < recipe.packer.size:
            number = payload[0] if payload else None
            self._controller.note(f"input package refused: recipe {number}, {len(payload)} bytes")
            self._say(connection, "An input package does not fit any recipe.", now)
            return
        values = recipe.packer.unpack_from(payload, 1)
        at = 0
        masked: dict[str, Any] = {}
        for name, target, width in recipe.fields:
            value = values[at] if width == 1 else values[at : at + width]
            at += width
            if recipe.masked and name in MASKED:
                masked[name] = value
            else:
                target.set(self._controller, value)
        if masked:
            apply_masked(self._controller, masked)
        self._controller.written(recipe.names)
        self._on_input(connection, payload[0], now)

    def frame(self, now: float) -> None:
        for connection, session in self._sessions.items():
            recipe = session.output
            if not session.started or recipe is None or self._controller.frame % recipe.every:
                continue
            values: list[Any] = [recipe.packer.size, DATA]
            if session.protocol >= 2:
                values.append(recipe.number)
            for get, vector in recipe.getters:
                if vector:
                    values += get(self._controller)
                else:
                    values.append(get(self._controller))
            for name in self.wrong.keys() & recipe.at.keys():
                values[recipe.at[name]] = self.wrong[name]
            connection.send(recipe.packer.pack(*values), now, droppable=True)

    def _reply(self, connection: Connection, kind: int, payload: bytes, now: float) -> None:
        connection.send(struct.pack(">HB", len(payload) + 3, kind) + payload, now)

    def _say(self, connection: Connection, text: str, now: float) -> None:
        session = self._sessions[connection]
        message, source = text.encode()[:255], b"RTDE"
        body = bytes([WARNING]) + message
        if session.protocol >= 2:
            body = bytes([len(message)]) + message + bytes([len(source)]) + source + bytes([WARNING])
        self._reply(connection, TEXT, body, now)


def _names(payload: bytes) -> list[str]:
    # ur_rtde ends its lists with a comma, the official clients do not
    return [name.strip() for name in payload.decode("ascii").split(",") if name.strip()]
