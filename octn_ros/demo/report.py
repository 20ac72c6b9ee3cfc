"""The report of a demo run: one HTML page with everything in it."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

NOTE = "Research software, no medical device."


@dataclass(frozen=True)
class ReportPicture:
    """One picture: its heading, a sentence or two below it, and the PNG."""

    heading: str
    caption: str
    png: bytes


def render_report(
    title: str,
    rows: Sequence[tuple[str, str]],
    pictures: Sequence[ReportPicture],
    configuration: dict[str, Any],
    versions: dict[str, str],
) -> str:
    """Return the page as HTML that needs no other file.

    Args:
        title: what was run.
        rows: the figures, (name, value with unit).
        pictures: in the order of the page.
        configuration: the resolved settings of every part, for a fold-out at the end.
        versions: of this package and of what it stands on.
    """
    return _PAGE.format(
        title=html.escape(title),
        style=_STYLE,
        figures=_table(rows),
        pictures="\n".join(_picture(picture) for picture in pictures),
        configuration="\n".join(_settings(name, value) for name, value in configuration.items()),
        versions=_table(list(versions.items())),
        note=NOTE,
    )


def _table(rows: Sequence[tuple[str, str]]) -> str:
    lines = []
    for name, value in rows:
        depends = ' class="part"' if name.startswith(" ") else ""
        lines.append(f"<tr><th{depends}>{html.escape(name.strip())}</th><td>{html.escape(value)}</td></tr>")
    return "<table>\n" + "\n".join(lines) + "\n</table>"


def _picture(picture: ReportPicture) -> str:
    data = base64.b64encode(picture.png).decode("ascii")
    heading, caption = html.escape(picture.heading), html.escape(picture.caption)
    return (
        f'<section>\n<h2>{heading}</h2>\n<figure><img alt="{heading}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>\n</section>"
    )


def _settings(name: str, value: Any) -> str:
    text = html.escape(json.dumps(value, indent=2, default=str))
    return f"<details><summary>{html.escape(name)}</summary><pre>{text}</pre></details>"


_STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; padding: 2.5rem 1.5rem 4rem; max-width: 62rem; background: #fff; color: #22262b;
       font: 16px/1.55 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.75rem; font-weight: 600; margin: 0 0 .25rem; letter-spacing: -.01em; }
h2 { font-size: 1.15rem; font-weight: 600; margin: 3rem 0 .75rem; }
p.note { margin: 0 0 2rem; color: #68707a; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: .4rem .75rem .4rem 0; border-bottom: 1px solid #e6e9ed; vertical-align: top; }
th { width: 19rem; font-weight: 400; color: #555b63; }
th.part { padding-left: 1.25rem; }
td { font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
figure { margin: 0; }
img { display: block; width: 100%; height: auto; }
figcaption { margin-top: .5rem; color: #555b63; font-size: .92rem; max-width: 50rem; }
details { border-bottom: 1px solid #e6e9ed; padding: .4rem 0; }
summary { cursor: pointer; }
pre { background: #f6f7f9; padding: .9rem 1rem; border-radius: 4px; overflow-x: auto; font-size: .85rem; }
footer { margin-top: 3rem; color: #68707a; font-size: .9rem; }
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<h1>{title}</h1>
<p class="note">{note}</p>
{figures}
{pictures}
<h2>Configuration</h2>
{configuration}
<h2>Versions</h2>
{versions}
<footer>{note} An independent implementation of OCTN (Prakash, McNabb, Codd, Lin).</footer>
</body>
</html>
"""
