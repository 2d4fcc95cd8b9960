"""A hook of MkDocs: pages may link to files of the repository that are outside docs/.

In the repository such links are plain relative links. On the site, whatever they point to is copied
to the same path, CONTRIBUTING.md and Markdown results as pages, and links are adapted. A comment
`<!-- include README.md: Heading -->` is replaced by that section of that file (without a heading:
by what is between its title and its first section), so that a text has one source.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DOCS = "docs/"
# the README is no page of the site: its parts are, where they are included
INSTEAD = {"README.md": "docs/index.md", "README.md#results": "docs/results/index.md"}

_LINK = re.compile(r"(\]\()([^)\s#]*)(#[^)\s]*)?(?=\))")
_INCLUDE = re.compile(r"<!-- include ([^:\s]+)(?:: (.+?))? -->")
_FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def site_path(path: str) -> str:
    """Where a file of the repository is among the site's sources."""
    return path.removeprefix(DOCS)


def linked_path(link: str, page: str) -> str | None:
    """The file of the repository that a relative link of a page points to; None for others."""
    if not link or ":" in link or link.startswith("/"):
        return None
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), link))


def adapted(markdown: str, source: str, page: str) -> str:
    """Markdown of the file `source`, whose links work from `page` on the site.

    Both are paths in the repository; they differ where a part of one is included in the other.
    """

    def link(match: re.Match[str]) -> str:
        anchor = match[3] or ""
        path = linked_path(match[2], source)
        if path is None:
            return match[0]
        if path + anchor in INSTEAD:
            path, anchor = INSTEAD[path + anchor], ""
        path = INSTEAD.get(path, path)
        target = posixpath.relpath(site_path(path), posixpath.dirname(site_path(page)) or ".")
        return f"{match[1]}{target}{anchor}"

    parts = _FENCE.split(markdown)  # code is at odd places
    return "".join(part if i % 2 else _LINK.sub(link, part) for i, part in enumerate(parts))


def section(markdown: str, heading: str | None) -> str:
    """The text of a section, without its heading; or of what is before all sections.

    Raises:
        ValueError: there is no such section.
    """
    parts = re.split(r"^## (.+)\n", markdown, flags=re.MULTILINE)
    if heading is None:
        return parts[0].partition("\n")[2]
    if heading not in parts[1::2]:
        raise ValueError(f"there is no section {heading!r} (there are: {', '.join(parts[1::2])})")
    return parts[parts.index(heading) + 1]


def included(markdown: str, page: str) -> str:
    """The page with the sections that it includes, all links adapted."""
    parts = []
    end = 0
    for match in _INCLUDE.finditer(markdown):
        parts.append(adapted(markdown[end : match.start()], page, page))
        parts.append(adapted(section((ROOT / match[1]).read_text(), match[2]), match[1], page))
        end = match.end()
    return "".join([*parts, adapted(markdown[end:], page, page)])


def outside_files(pages: Iterable[str]) -> list[str]:
    """Files outside docs/ that pages link to, and that Markdown among those links to."""
    found: list[str] = []
    waiting = list(pages)
    while waiting:
        page = waiting.pop()
        text = (ROOT / page).read_text()
        sources = {page: text}
        for match in _INCLUDE.finditer(text):
            sources[match[1]] = section((ROOT / match[1]).read_text(), match[2])
        links = [(m[2], source) for source, text in sources.items() for m in _LINK.finditer(text)]
        for link, source in links:
            path = linked_path(link, source)
            if path is None or path.startswith(DOCS) or path in (*INSTEAD, *found):
                continue
            if (ROOT / path).is_file():  # MkDocs warns of links to what is not there
                found.append(path)
                waiting += [path] * path.endswith(".md")
    return sorted(found)


def on_files(files: Any, config: Any) -> Any:
    """Adds the files outside docs/ that the pages need."""
    from mkdocs.structure.files import File  # noqa: PLC0415  (tests import this file without it)

    pages = [DOCS + file.src_uri for file in files.documentation_pages()]
    for path in dict.fromkeys(["CONTRIBUTING.md", "CHANGELOG.md", *outside_files(pages)]):
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Includes sections and adapts the links."""
    uri = page.file.src_uri
    inside = (ROOT / DOCS / uri).is_file()
    return included(markdown, DOCS + uri if inside else uri)
