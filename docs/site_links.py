"""A hook of MkDocs: the repository's README as a page, and links that leave ``docs/``.

On GitHub such a link opens the file. The site has no file to open, so only the link's text is kept; one to
the README opens its page. A link to nothing stays as it is, and ``mkdocs build --strict`` fails on it.
"""

import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from pymdownx.slugs import slugify

ROOT = Path(__file__).parents[1]
README_PAGE = "start.md"
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s:]+)(#[^)\s]*)?\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Headings get GitHub's anchors, so that a link to one works there and here."""
    config.mdx_configs["toc"]["slugify"] = slugify(case="lower")
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the README."""
    files.append(File.generated(config, README_PAGE, content=(ROOT / "README.md").read_text()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links as the site needs them."""
    docs = Path(config.docs_dir)
    is_readme = page.file.src_uri == README_PAGE
    folder = ROOT if is_readme else (docs / page.file.src_uri).parent
    shown_in = docs if is_readme else folder

    def link(match: re.Match[str]) -> str:
        image, text, path, anchor = match.groups(default="")
        target = Path(os.path.normpath(folder / path))
        if target == ROOT / "README.md":
            target = docs / README_PAGE
        elif target.exists() and not target.is_relative_to(docs):
            return text
        url = f"{os.path.relpath(target, shown_in)}{anchor}"
        return f"[![{text}]({url})]({url})" if image else f"[{text}]({url})"  # an image opens in full size

    return LINK.sub(link, markdown)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Name the theme's search for screen readers."""
    named = 'aria-label="Search"'
    output = output.replace('id="__search"', f'id="__search" {named}')
    return output.replace(
        'data-md-component="search" role="dialog"', f'data-md-component="search" role="dialog" {named}'
    )
