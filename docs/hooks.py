"""What the site does beside Markdown: pages from the repository's root, notebooks, and formulas as MathML."""

import re
from pathlib import Path
from typing import Any

import jupytext
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files, InclusionLevel

ROOT = Path(__file__).parents[1]
FROM_ROOT = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
"""Files beside `docs/` that are pages of the site, by their names there."""
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_LINK = re.compile(r"\]\((?:\.\./)*\.\./([A-Z]+\.md|jaxfilters/__init__\.pyi)(#[\w-]*)?\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that lie beside `docs/`, and each script of the gallery as a page and as a notebook."""
    for name, page in FROM_ROOT.items():
        text = (
            (ROOT / name).read_text().replace("](docs/", "](").replace("](jaxfilters/__init__.pyi", "](api/running.md")
        )
        files.append(File.generated(config, page, content=text))
    for script in sorted((ROOT / "docs" / "examples").glob("*.py")):
        files.append(
            File.generated(
                config, f"examples/{script.stem}.md", content=_page_of(script), inclusion=InclusionLevel.NOT_IN_NAV
            )
        )
        notebook = jupytext.writes(jupytext.read(script), fmt="ipynb")
        files.append(File.generated(config, f"examples/{script.stem}.ipynb", content=notebook))
    return files


def _page_of(script: Path) -> str:
    """A script in jupytext's percent format as Markdown: its text, its code, then its picture."""
    parts = []
    for cell in re.split(r"^# %%", script.read_text(), flags=re.MULTILINE)[1:]:
        kind, _, body = cell.partition("\n")
        if "[markdown]" in kind:
            parts.append(re.sub(r"^# ?", "", body, flags=re.MULTILINE).strip())
        else:
            title = f"# {kind.strip()}\n" if kind.strip() else ""
            parts.append(f"```python\n{title}{body.strip()}\n```")
    picture = f"![The picture that the script draws](images/{script.stem}.webp)"
    return "\n\n".join([*parts, picture, f"[This page as a notebook]({script.stem}.ipynb)\n"])


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links out of `docs/` lead to the pages of the site that stand for them."""
    up = "../" * page.file.src_uri.count("/")
    pages = FROM_ROOT | {"README.md": "index.md", "jaxfilters/__init__.pyi": "api/running.md"}
    markdown = re.sub(r"\]\((examples/\w+)\.py\)", r"](\1.md)", markdown)  # scripts are pages of the site
    markdown = re.sub(r"^```python (\w+)$", r'```python title="\1"', markdown, flags=re.MULTILINE)
    return _LINK.sub(lambda found: f"]({up}{pages[found[1]]}{found[2] or ''})", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Put MathML in the place of LaTeX, which browsers draw themselves.

    Raises:
        PluginError: If a block of code was taken for text.
    """
    if "```" in html:
        raise PluginError(f"a fence that is no block of code: {html[html.index('```') :][:60]!r}")

    def drawn(found: re.Match[str]) -> str:
        latex = found[3].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">")
        return convert(latex, display="block" if found[1] == "div" else "inline")

    return _FORMULA.sub(drawn, html)


def on_post_page(output: str, **_: Any) -> str:
    """Remove the one script that the theme would load from the network, for the search of pages opened as files."""
    return re.sub(r'<script src="https://unpkg\.com/[^"]*"></script>', "", output)


def on_post_template(output_content: str, **_: Any) -> str:
    """The same for the page of addresses that do not exist."""
    return on_post_page(output_content)
