"""Pages of the site besides `docs/`: the README as its home, the examples with README and sources, files in pages."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
LANGUAGES = {".py": "python", ".yaml": "yaml"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made of files elsewhere in the repository."""
    files.append(File.generated(config, "index.md", content=_for_the_site((ROOT / "README.md").read_text())))
    files.append(File.generated(config, "examples.md", content=_gallery()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Make links to examples point into the gallery, and insert a file that a page names as `<!-- file: -->`."""
    text = re.sub(r"\]\((?:\.\./)*examples/(\w+)/README\.md\)", r"](examples.md#\1)", markdown)
    text = re.sub(r"\[([^\]]+)\]\(\.\./[^)]+\)", r"`\1`", text)
    return re.sub(r"<!-- file: (.+) -->", lambda named: _shown(ROOT / named[1]), text)


def _for_the_site(text: str) -> str:
    """Make links of the repository's front page relative to `docs/`; links to files that are not pages are removed."""
    text = text.replace("](docs/", "](").replace("](examples/README.md)", "](examples.md)")

    def keep(link: re.Match[str]) -> str:
        name, target = link[1], link[2]
        there = "://" in target or target == "examples.md" or (ROOT / "docs" / target).is_file()
        return link[0] if there else f"`{name}`"

    return re.sub(r"(?<!!)\[([^\]]+)\]\(([^)#]+)\)", keep, text)


def _shown(file: Path) -> str:
    return f"```{LANGUAGES[file.suffix]}\n{file.read_text()}```"


def _gallery() -> str:
    parts = [(ROOT / "examples" / "README.md").read_text()]
    for folder in sorted(path for path in (ROOT / "examples").iterdir() if path.is_dir()):
        title, _, text = (folder / "README.md").read_text().partition("\n")
        parts.append(f"#{title} {{#{folder.name}}}\n{text}".replace("](../../docs/", "]("))
        for source in sorted(folder.iterdir()):
            if source.suffix in LANGUAGES:
                parts.append(f"`{source.relative_to(ROOT)}`\n\n{_shown(source)}")
    # links to the READMEs point to the parts below
    return re.sub(r"\]\((\w+)/README\.md\)", r"](#\1)", "\n\n".join(parts))
