"""Profiles of GenICam devices: features to write, how to trigger, and units, as data."""

from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import as_file, files

from weldcal.models.documents import read_document
from weldcal.models.errors import InputError


@dataclass(frozen=True)
class Profile:
    """What profiles.yaml says of one kind of device."""

    settings: dict[str, str] = field(default_factory=dict)
    scans: dict[str, str] = field(default_factory=dict)
    stream: dict[str, str] = field(default_factory=dict)
    trigger: str = ""
    alive: str = ""
    unit: str = "device"

    def features(self, *, streams: bool, own: dict[str, str]) -> dict[str, str]:
        """Every feature to write, in order; the scenario's own replace those of the profile."""
        return {**self.settings, **(self.stream if streams else self.scans), **own}


@cache
def profiles() -> dict[str, Profile]:
    """All profiles by name."""
    with as_file(files(__package__).joinpath("profiles.yaml")) as path:
        document = read_document(path)
    return {name: replace(Profile(), **keys) for name, keys in document.items()}


def get_profile(name: str) -> Profile:
    """The named profile; raises InputError naming the known ones."""
    found = profiles().get(name)
    if found is None:
        raise InputError(f"There is no GenICam profile '{name}': use one of {', '.join(profiles())}.")
    return found
