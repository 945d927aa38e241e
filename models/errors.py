"""Base classes of all named exceptions."""

_LONGEST = 1000  # characters


class WeldcalError(Exception):
    """A problem that the user can put right; its text is one clear sentence that says what to change."""


class InputError(WeldcalError):
    """Something that was handed in cannot be used as it is (a file, a number, a unit, a scenario).

    Its text is on one line, and shortened in its middle where what was handed in makes it endless.
    """

    def __init__(self, sentence: object = "") -> None:
        text = str(sentence)
        if len(text) > _LONGEST:
            text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
        super().__init__(" ".join(text.split()) if "\n" in text else text)
