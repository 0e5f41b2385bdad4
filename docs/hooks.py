"""What the site does beside Markdown: pages from the repository's root, and formulas as MathML, without scripts."""

import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
FROM_ROOT = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
"""Files beside `docs/` that are pages of the site, by their names there."""
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_LINK = re.compile(r"\]\((?:\.\./)*\.\./([A-Z]+\.md|jaxfilters/__init__\.pyi)(#[\w-]*)?\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that lie beside `docs/`."""
    for name, page in FROM_ROOT.items():
        text = (
            (ROOT / name).read_text().replace("](docs/", "](").replace("](jaxfilters/__init__.pyi", "](api/running.md")
        )
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links out of `docs/` lead to the pages of the site that stand for them."""
    up = "../" * page.file.src_uri.count("/")
    pages = FROM_ROOT | {"README.md": "index.md", "jaxfilters/__init__.pyi": "api/running.md"}
    return _LINK.sub(lambda found: f"]({up}{pages[found[1]]}{found[2] or ''})", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Put MathML in the place of LaTeX, which browsers draw themselves."""

    def drawn(found: re.Match[str]) -> str:
        latex = found[3].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">")
        return convert(latex, display="block" if found[1] == "div" else "inline")

    return _FORMULA.sub(drawn, html)
