"""Writes what a result shows: HTML pages of templates, JSON and CSV files, and numbers."""

import base64
import csv
import hashlib
import io
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, pass_environment
from markupsafe import Markup, escape

from weldcal.calibration.data.results import (
    KINEMATICS_FILE,
    CalibrationResult,
    export_all,
    save_result,
    software_version,
)
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import write_atomic as write_atomic
from weldcal.tools.console import plain

_MEDIA_TYPES = ((b"\x89PNG", "image/png"), (b"\xff\xd8\xff", "image/jpeg"), (b"<svg", "image/svg+xml"))

_OPTION = re.compile(r"(?<![\w-])(--[a-z][a-z-]*)")


def check_folder(out: Path, what: str = "result") -> None:
    """Check that a folder can be written. Raises InputError where a file has its name."""
    if out.exists() and not out.is_dir():
        raise InputError(f"'{out}' is a file. Give a folder for the {what}.")


def render(template: str, **context: object) -> str:
    """Return the HTML of a template of this folder.

    Everything from the context is escaped; a name that the template uses and the context lacks is an error. Pictures
    are handed over as bytes (PNG, JPEG or SVG) and end inside the page, so that it needs no other file and no network.

    Args:
        template: file name in tools/report, such as "calibration.html.j2"; it extends "base.html.j2".
        context: what the template shows, besides `software`, the version of this package.

    Raises:
        jinja2.UndefinedError: if the context lacks a name.
    """
    return environment().get_template(template).render(software=software_version(), **context)


def optioned(text: str) -> Markup:
    """Return the escaped text, with options of the command line (--limit-mm) that are not broken at their hyphens."""
    return Markup(_OPTION.sub(r'<span class="option">\1</span>', str(escape(text))))


def inlined(picture: bytes, alt: str) -> Markup:
    """Return the picture as a part of the page: an SVG in the colours of the page, any other picture as an image."""
    if b"<svg" in picture[:1024]:
        return inline_svg(picture.decode(), alt)
    return Markup('<img src="{}" alt="{}">').format(data_uri(picture), alt)


def data_uri(picture: bytes) -> str:
    """Return the picture as the text of a data: address.

    Raises:
        ValueError: if it is neither PNG, JPEG nor SVG.
    """
    head = picture[:1024]
    for magic, media_type in _MEDIA_TYPES:
        if head.startswith(magic) or (magic == b"<svg" and magic in head):
            return f"data:{media_type};base64,{base64.b64encode(picture).decode('ascii')}"
    raise ValueError("a picture in a report must be PNG, JPEG or SVG")


def fixed(value: float | None, digits: int = 2) -> str:
    """Return the number with that many decimals; a dash for None and NaN, the sign ∞ for an infinite one."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    text = f"{value:.{digits}f}"
    return text.replace("-", "−") if float(text) else f"{0:.{digits}f}"


def fixed_row(values: Iterable[float], digits: int = 2) -> str:
    """Numbers as ``fixed`` writes them, in one row."""
    return "  ".join(fixed(float(value), digits) for value in values)


def sigma_rows(covariance: Array) -> list[tuple[str, str]]:
    """Return the two rows of one sigma of a pose with covariance (6, 6) [rotation; translation], rad and m."""
    sigma = np.sqrt(np.diag(covariance))
    return [
        ("one sigma of the position (origin of the scanner), mm", fixed_row(1e3 * sigma[3:], 3)),
        ("one sigma of the rotation, deg", fixed_row(np.degrees(sigma[:3]), 4)),
    ]


def environment() -> Environment:
    """The Jinja environment of the reports: everything escaped, every name required, one stylesheet."""
    reports = Environment(
        loader=PackageLoader("weldcal.tools.report", package_path="."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    reports.filters["data_uri"] = data_uri
    reports.filters["fixed"] = fixed
    reports.filters["inlined"] = inlined
    reports.filters["optioned"] = optioned
    reports.globals |= {"stylesheet": _stylesheet, "script": _script, "script_hash": _script_hash}
    return reports


@pass_environment
def _stylesheet(reports: Environment) -> Markup:
    loader = reports.loader
    assert loader is not None
    return Markup(loader.get_source(reports, "style.css")[0])


@pass_environment
def _script(reports: Environment) -> Markup:
    loader = reports.loader
    assert loader is not None
    return Markup(loader.get_source(reports, "copy.js")[0])


@pass_environment
def _script_hash(reports: Environment) -> str:
    """Return the script's name in the page's policy: no other script runs in it."""
    digest = hashlib.sha256(_script(reports).encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"


_INK = ("#000000", "#222", "#222222", "#333", "#333333", "#444", "#444444", "#555", "#555555", "#888", "#888888")
_PLOT = {
    "#1d5f8a": "ours",
    "#b08a2e": "theirs",
    "#a8402f": "truth",
    "#9aa3ab": "grey",
    "#d9700f": "torch",
    "#5b7d4e": "third",
}
"""Colours of the curves, by the name of their variable in style.css, where they are lighter on a dark page."""
HIGH, TALL = 0.6, 1.0
"""Height over width from which a plot gets more of a printed page."""
_DROPPED = re.compile(r"<\?xml.*?\?>|<!DOCTYPE.*?>|<!--.*?-->|<metadata>.*?</metadata>|<style.*?</style>", re.DOTALL)
_COLOUR = re.compile(r"#[0-9a-fA-F]{6}\b|#[0-9a-fA-F]{3}\b")
_STYLE = re.compile(r'style="[^"]*"')


def inline_svg(svg: str, alt: str) -> Markup:
    """The SVG's markup as an image with an alternative text; its ids are its own, so that several stand in one page.

    Black and dark greys become the page's text colour, white its ground, the faint grid its lines; curves keep their
    hue.
    """
    name = hashlib.sha256(svg.encode()).hexdigest()[:8]
    text = _DROPPED.sub("", svg).strip()
    text = _STYLE.sub(lambda found: _COLOUR.sub(_coloured, found[0]), text)
    text = re.sub(r'\bid="([^"]+)"', rf'id="f{name}-\1"', text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#f{name}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#f{name}-\1)", text)
    # a glyph without a style is black by default
    text = re.sub(r"<svg\b([^>]*)>", lambda found: _opening(found[1], alt), text, count=1)
    return Markup(text)


def _opening(attributes: str, alt: str) -> str:
    """Return the svg element: as wide as its box, named for who cannot see it."""
    size = re.search(r'viewBox="[\d.]+ [\d.]+ ([\d.]+) ([\d.]+)"', attributes)
    ratio = float(size[2]) / float(size[1]) if size else 0.0
    shape = " tall" if ratio > TALL else " high" if ratio > HIGH else ""
    kept = re.sub(r'\s(width|height|version|xmlns(:\w+)?)="[^"]*"', "", attributes)
    return f'<svg class="plot{shape}" role="img" aria-label="{escape(alt)}" fill="currentColor"{kept}>'


def _coloured(found: re.Match[str]) -> str:
    colour = found[0].lower()
    if colour in _INK:
        return "currentColor"
    if colour in ("#ffffff", "#fff"):
        return "var(--surface)"
    if colour in ("#e3e6e9", "#b0b0b0", "#cccccc"):
        return "var(--line)"
    return f"var(--plot-{_PLOT[colour]})" if colour in _PLOT else found[0]


def save_all(result: CalibrationResult, folder: Path, kinematics: str = "") -> None:
    """Write the exports, the text of refined ``kinematics``, and last calibration.yaml: then everything is there."""
    export_all(result, folder)
    if kinematics:
        write_atomic(folder / KINEMATICS_FILE, kinematics)
    save_result(result, folder)


def write_json(path: Path, content: object) -> None:
    """Write the content, in JSON's own types (what is not finite becomes null), with its folder."""
    write_atomic(path, json.dumps(plain(content), allow_nan=False, indent=1) + "\n")


def csv_text(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a header line and one line per row."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def mappings_csv(rows: Sequence[Mapping[str, object]], columns: Sequence[str] = ()) -> str:
    """Mappings, one line each: these keys, or all."""
    columns = columns or list(dict.fromkeys(key for row in rows for key in row))
    return csv_text(columns, ([row.get(name, "") for name in columns] for row in rows))
