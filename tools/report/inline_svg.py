"""Puts an SVG of matplotlib into a page: its lines and words in the colour of the page's text, light and dark."""

import hashlib
import re

from markupsafe import Markup, escape

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

    Black and dark greys become the page's text colour, white its ground, the faint grid its lines; curves keep their hue.
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
    """The svg element: as wide as its box, named for who cannot see it."""
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
