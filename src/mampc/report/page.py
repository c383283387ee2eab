"""A page of text, tables and figures, written as Markdown and as one self-contained HTML file."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from pathlib import Path

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; }
body { max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; font-size: 0.85rem; margin: 1rem 0; display: block; overflow-x: auto; }
th, td { border-bottom: 1px solid #ddd; padding: 0.25rem 0.6rem; text-align: right; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1.5rem 0; } figure svg { width: 100%; max-width: 50rem; height: auto; }
figcaption { font-size: 0.85rem; color: #555; }
h1, h2, h3 { line-height: 1.2; }
"""


class Page:
    """Collects blocks in order; `texts` puts them together."""

    def __init__(self, title: str) -> None:
        self.title = title
        self._markdown = [f"# {title}"]
        self._html = [f"<h1>{html.escape(title)}</h1>"]
        self._figures: dict[str, str] = {}

    def heading(self, text: str, level: int = 2) -> None:
        self._markdown.append(f"{'#' * level} {text}")
        self._html.append(f"<h{level}>{html.escape(text)}</h{level}>")

    def text(self, text: str) -> None:
        """A paragraph; *emphasis* and **strong** are the marks it may hold."""
        self._markdown.append(text)
        strong = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", html.escape(text))
        emphasised = re.sub(r"\*(.+?)\*", r"<em>\1</em>", strong)
        self._html.append(f"<p>{emphasised}</p>")

    def table(self, header: list[str], rows: list[list[str]]) -> None:
        lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
        self._markdown.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
        body = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
        self._html.append(f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")

    def figure(self, path: str, caption: str) -> None:
        """An SVG file at `path`, relative to the page; its drawing becomes part of the HTML."""
        self._markdown.append(f"![{caption}]({path})")
        mark = f"<!-- figure {len(self._figures)} -->"
        self._figures[mark] = path
        self._html.append(f"<figure>{mark}<figcaption>{html.escape(caption)}</figcaption></figure>")

    def texts(self, folder: Path) -> Iterator[tuple[str, str]]:
        """Ending and text of the page's files, Markdown and HTML; `folder` holds the figures already."""
        yield "md", "\n\n".join(self._markdown) + "\n"
        body = "\n".join(self._html)
        for number, (mark, path) in enumerate(self._figures.items()):
            body = body.replace(mark, _drawing((folder / path).read_text(encoding="utf-8"), f"f{number}-"))
        head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        head += f"<title>{html.escape(self.title)}</title><style>{STYLE}</style>"
        page = f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'
        yield "html", page


def _drawing(svg: str, prefix: str) -> str:
    """The svg element alone, its ids made the page's own so that drawings do not share them."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)
    svg = re.sub(r'\bid="', f'id="{prefix}', svg)
    svg = re.sub(r'(href="#|url\(#)', rf"\g<1>{prefix}", svg)
    return svg
