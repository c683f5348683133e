"""One self-contained HTML file: no network, opens from disk, reads on a phone and in print."""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from improvo.files import write_text
from improvo.untrusted.paths import as_text

# an absolute path of this machine, of Unix or Windows; what is behind a letter, as in a/b or https://a/b, is none
_ABSOLUTE = re.compile(r"(?<![\w./:])(?:/(?:[^/\s\"'`<>|]+/)+|[A-Za-z]:\\(?:[^\\\s\"'`<>|]+\\)+)(?=[^/\s])")


_BAR = re.compile(r"(?<!\\)\|")  # between two cells of a table
_EDGES = re.compile(r"^\s*\||(?<!\\)\|\s*$")  # its bars at both ends
_WIDE = 2.0  # width over height of pictures that would be too small beside each other


def plain(text: str) -> str:
    """Text as markup: escaped, and without the folders of this machine, since pages are sent to others.

    Where a folder ends cannot be told if its name has spaces; a `Page` is given such folders.
    """
    return escape(as_text(_ABSOLUTE.sub("", text)))


def as_json(data: Any) -> str:
    """Data for people, indented; of a text that is a path as a whole the folders are left out."""

    def named(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: named(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [named(item) for item in value]
        if not isinstance(value, str):
            return value
        kind = next((kind for kind in (PurePosixPath, PureWindowsPath) if kind(value).is_absolute()), None)
        return value if kind is None else kind(value).name or value

    return json.dumps(named(data), indent=2, ensure_ascii=False)


class Page:
    """Collects sections, then writes them.

    Text arguments are plain text: they are escaped, and absolute paths lose their folders; only `html` takes markup.

    Args:
        title: of the page.
        lead: one line below it.
        folders: of this machine, whose names no text shall have.
    """

    def __init__(self, title: str, lead: str, folders: Iterable[Path] = ()) -> None:
        self._title = title
        named = {f"{folder}{os.sep}" for folder in folders if folder.is_absolute() and folder.name}
        self._folders = sorted(named, key=len, reverse=True)
        self._body = [f"<h1>{self._plain(title)}</h1>", f'<p class="lead">{self._plain(lead)}</p>']
        self._scripts: list[str] = []

    def html(self, markup: str) -> None:
        """Append trusted markup."""
        self._body.append(markup)

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._body.append(f"<h2>{self._plain(text)}</h2>")

    def paragraph(self, text: str, note: bool = False) -> None:
        """A paragraph; `note` sets it small."""
        opening = '<p class="note">' if note else "<p>"
        self._body.append(f"{opening}{self._plain(text)}</p>")

    def tiles(self, numbers: Sequence[tuple[str, str]]) -> None:
        """The main numbers: (value, meaning)."""
        tiles = "".join(
            f'<div class="tile"><b>{self._plain(value)}</b><span>{self._plain(text)}</span></div>'
            for value, text in numbers
        )
        self._body.append(f'<div class="tiles">{tiles}</div>')

    def warnings(self, lines: Sequence[str], fine: str) -> None:
        """What to look out for, in plain words; `fine` is said where there is nothing."""
        items = (
            "".join(f"<li>{self._plain(line)}</li>" for line in lines) or f'<li class="fine">{self._plain(fine)}</li>'
        )
        self._body.append(f'<ul class="warnings">{items}</ul>')

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> None:
        """A table; cells wrapped in ** are bold."""
        head = "".join(f"<th>{self._cell(cell)}</th>" for cell in header)
        body = "".join("<tr>" + "".join(f"<td>{self._cell(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        below = f"<figcaption>{self._plain(caption)}</figcaption>" if caption else ""
        self._body.append(
            f'<figure><div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
            f"{below}</figure>"
        )

    def bars(
        self, header: Sequence[str], rows: Sequence[tuple[str, float, str]], colours: Mapping[str, str] | None = None
    ) -> None:
        """A table of (name, value, value in words) with a bar for each value; `colours` (CSS) of names are a legend."""
        colours = colours or {}
        largest = max((value for _, value, _ in rows), default=0.0) or 1.0
        body = "".join(
            f'<tr><td>{swatch(colours.get(name))}{self._plain(name)}</td><td>{self._plain(words)}</td><td class="bar">'
            f'<i style="width:{100 * value / largest:.1f}%"></i></td></tr>'
            for name, value, words in rows
        )
        head = "".join(f"<th>{self._plain(cell)}</th>" for cell in (*header, ""))
        self._body.append(
            f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )

    def markdown(self, text: str) -> None:
        """Our own Markdown subset: headings, paragraphs, lists and tables, as the evaluations print them."""
        for block in re.split(r"\n\s*\n", text.strip()):
            lines = block.strip().splitlines()
            table = [line for line in lines if line.lstrip().startswith("|")]
            items = [line for line in lines if line.startswith("- ")]
            rest = [line for line in lines if line not in table and line not in items]
            if items:
                self.html("<ul>" + "".join(f"<li>{self._cell(item[2:])}</li>" for item in items) + "</ul>")
            for line in rest:
                if line.startswith("#"):
                    self.html(f"<h3>{self._plain(line.lstrip('# '))}</h3>")
                elif line.strip():
                    self.html(f"<p>{self._cell(line)}</p>")
            rows = [[cell.strip().replace("\\|", "|") for cell in _BAR.split(_EDGES.sub("", line))] for line in table]
            rows = [row for row in rows if not all(re.fullmatch(r":?-+:?", cell) for cell in row)]
            if rows:
                self.table(rows[0], rows[1:])

    def picture(self, content: bytes | Path, caption: str, narrow: bytes | None = None) -> None:
        """A PNG or JPEG, embedded; `narrow` is the same for telephones, with larger letters."""
        self._body.append(_figure(content, self._plain(caption), narrow))

    def side_by_side(self, pictures: Sequence[tuple[Path, str]]) -> None:
        """Pictures with captions in one row; below each other where the screen is narrow, or the pictures are wide."""
        figures = "".join(_figure(content, self._plain(caption)) for content, caption in pictures)
        wide = any(_aspect(content) > _WIDE for content, _ in pictures)
        self._body.append(f'<div class="pair{" wide" if wide else ""}">{figures}</div>')

    def details(self, summary: str, text: str) -> None:
        """Text that unfolds."""
        self._body.append(f"<details><summary>{self._plain(summary)}</summary><pre>{self._plain(text)}</pre></details>")

    def script(self, asset: str, data_id: str, data: Any) -> None:
        """A script of ours, and the data that it reads from the element `data_id`."""
        text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
        self._body.append(f'<script type="application/json" id="{data_id}">{text}</script>')
        self._scripts.append(_asset(asset))

    def write(self, path: Path) -> None:
        """Write the file atomically."""
        from improvo import __version__

        scripts = "".join(f"<script>{script}</script>\n" for script in self._scripts)
        write_text(
            path,
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f'<link rel="icon" href="data:,"><title>{self._plain(self._title)}</title>'
            f"<style>{_asset('page.css')}</style>"
            f"</head><body>\n{chr(10).join(self._body)}\n"
            f'<p class="note">Written by improvo {__version__}.</p>\n{scripts}</body></html>\n',
        )

    def _plain(self, text: str) -> str:
        for folder in self._folders:
            text = text.replace(folder, "")
        return plain(text)

    def _cell(self, text: str) -> str:
        return re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", self._plain(text))


def swatch(colour: str | None) -> str:
    """Markup: a patch of a colour (CSS) before a word; nothing without one."""
    return "" if colour is None else f'<i class="swatch" style="background:{colour}"></i> '


def _figure(content: bytes | Path, caption: str, narrow: bytes | None = None) -> str:
    """Markup; the caption is markup already."""
    image = f'<img src="{_embedded(content)}" alt="{caption}">'
    if narrow is not None:
        source = f'<source media="(max-width: 600px)" srcset="{_embedded(narrow)}">'
        image = f"<picture>{source}{image}</picture>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _aspect(picture: Path) -> float:
    """Width over height."""
    from PIL import Image

    with Image.open(picture) as image:
        return image.width / image.height


def _embedded(content: bytes | Path) -> str:
    content = content.read_bytes() if isinstance(content, Path) else content
    kind = "png" if content.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _asset(name: str) -> str:
    return files("improvo.report").joinpath("assets", name).read_text(encoding="utf-8")
