"""The blocks that a report is made of, each as Markdown and as HTML.

In their texts `code` and **bold** are marked as in Markdown. HTML is escaped and refers to nothing outside of its page.
"""

from __future__ import annotations

import base64
import html
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

BETTER, WITHIN, WORSE = "✓", "≈", "✗"  # first characters of cells of tables, which have colours
_CLASSES = {BETTER: "better", WITHIN: "within", WORSE: "worse"}
VIDEO_TYPES = {".gif": "image/gif", ".mp4": "video/mp4", ".webm": "video/webm"}
_WIDTH = 120  # characters of a line of Markdown
_STYLE = """
:root { color-scheme: light dark; --back: #fff; --text: #1a1a1a; --line: #ccc; --soft: #f3f3f3;
  --better: #d5efdb; --within: #fdf1c7; --worse: #fadbd8; }
@media (prefers-color-scheme: dark) { :root { --back: #16181c; --text: #e6e6e6; --line: #444; --soft: #24272d;
  --better: #17462a; --within: #4d4213; --worse: #57211d; } }
body { background: var(--back); color: var(--text); font: 16px/1.5 system-ui, sans-serif; max-width: 100rem;
  margin: 0 auto; padding: 0 1rem 3rem; }
nav { display: flex; flex-wrap: wrap; gap: .3rem 1.2rem; } p, ul { max-width: 60rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .83rem; margin: .6rem 0; }
th, td { border: 1px solid var(--line); padding: .25rem .35rem; text-align: left; white-space: nowrap; }
th { background: var(--soft); }
tr:not(.more):has(+ .more) td { border-top: 2px solid var(--text); }
tr:has(+ .more) td:first-child { border-bottom: none; } .more td:first-child { border-top: none; }
.better { background: var(--better); } .within { background: var(--within); } .worse { background: var(--worse); }
pre { background: var(--soft); padding: .7rem; overflow-x: auto; font-size: .85rem; }
figure { margin: 1.2rem 0; } img, video { max-width: 100%; height: auto; background: #fff; }
@media (max-width: 40rem) { th, td { white-space: normal; overflow-wrap: anywhere; min-width: 5.5rem; } }
"""


class Block(Protocol):
    """A part of a report."""

    def markdown(self) -> str:
        """Return it as Markdown."""

    def html(self) -> str:
        """Return it as HTML."""


@dataclass
class Heading:
    """A heading, of level 2 or 3 below that of the page."""

    text: str
    level: int = 2

    def markdown(self) -> str:
        """Return it after as many signs as its level has."""
        return f"{'#' * self.level} {self.text}"

    def html(self) -> str:
        """Return it as a place to jump to."""
        return f'<h{self.level} id="{anchor(self.text)}">{inline(self.text)}</h{self.level}>'


@dataclass
class Paragraph:
    """A text."""

    text: str

    def markdown(self) -> str:
        """Return its lines."""
        return textwrap.fill(self.text, _WIDTH, break_long_words=False, break_on_hyphens=False)

    def html(self) -> str:
        """Return it as one line."""
        return f"<p>{inline(self.text)}</p>"


@dataclass
class Bullets:
    """A list of texts."""

    items: Sequence[str]

    def markdown(self) -> str:
        """Return a line per text."""
        return "\n".join(f"- {' '.join(item.split())}" for item in self.items)

    def html(self) -> str:
        """Return the list."""
        return f"<ul>{''.join(f'<li>{inline(item)}</li>' for item in self.items)}</ul>"


@dataclass
class Grid:
    """A table; a cell that begins with one of the signs of this module has its colour.

    A row whose first cell is empty belongs to the group of the row above.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """Return a line per row."""
        rows = [self.header, ["---"] * len(self.header), *self.rows]
        cells = [[" ".join(cell.replace("|", "\\|").split()) for cell in row] for row in rows]
        return "\n".join(f"| {' | '.join(row)} |" for row in cells)

    def html(self) -> str:
        """Return the table, which can be scrolled sideways."""
        head = "".join(f"<th>{inline(cell)}</th>" for cell in self.header)
        rows = ((' class="more"' if row[0] == "" else "", "".join(map(self._cell, row))) for row in self.rows)
        body = "".join(f"<tr{kind}>{cells}</tr>\n" for kind, cells in rows)
        return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table></div>'

    def _cell(self, text: str) -> str:
        """Return a cell with the colour of its sign."""
        kind = _CLASSES.get(text[:1])
        return f'<td class="{kind}">{inline(text)}</td>' if kind else f"<td>{inline(text)}</td>"


@dataclass
class Code:
    """A text as it is; with a title, only pages have it, folded away."""

    text: str
    language: str
    title: str = ""

    def markdown(self) -> str:
        """Return it between fences that it does not have itself; nothing if it has a title."""
        longest = max(map(len, re.findall(r"`+", self.text)), default=0)
        fence = "`" * max(3, longest + 1)
        return "" if self.title else f"{fence}{self.language}\n{self.text.rstrip()}\n{fence}"

    def html(self) -> str:
        """Return it, folded away if it has a title."""
        code = f"<pre><code>{html.escape(self.text)}</code></pre>"
        return f"<details><summary>{inline(self.title)}</summary>{code}</details>" if self.title else code


@dataclass
class Picture:
    """A PNG, or a video of a type that is known; pages hold the file itself."""

    title: str
    file: Path

    def markdown(self) -> str:
        """Return a reference to a PNG in the folder of the report; nothing for a video."""
        return "" if self.file.suffix in VIDEO_TYPES else f"![{self.title}]({self.file.name})"

    def html(self) -> str:
        """Return picture or video with its title."""
        kind, title = VIDEO_TYPES.get(self.file.suffix, "image/png"), html.escape(self.title)
        source = f"data:{kind};base64,{base64.b64encode(self.file.read_bytes()).decode()}"
        shown = f'<img alt="{title}" src="{source}">'
        if kind.startswith("video"):
            shown = f'<video aria-label="{title}" controls muted loop playsinline src="{source}"></video>'
        return f"<figure>{shown}<figcaption>{title}</figcaption></figure>"


def inline(text: str) -> str:
    """Return a text as HTML."""
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", text)


def anchor(text: str) -> str:
    """Return the name of a heading as a place of a page."""
    return re.sub(r"\W+", "-", text.lower()).strip("-")


def to_markdown(title: str, blocks: Sequence[Block]) -> str:
    """Return a report as Markdown."""
    return "\n\n".join(filter(None, [f"# {title}", *(block.markdown() for block in blocks)])) + "\n"


def to_html(title: str, blocks: Sequence[Block]) -> str:
    """Return a report as one page."""
    places = [block.text for block in blocks if isinstance(block, Heading) and block.level == 2]
    links = "".join(f'<a href="#{anchor(text)}">{inline(text)}</a>' for text in places)
    parts = [
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>{inline(title)}</h1><nav>{links}</nav>",
        *(block.html() for block in blocks),
        "</body></html>\n",
    ]
    return "\n".join(parts)
