"""What the documentation's site adds to MkDocs: links out of docs/, sections, fields' comments."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs.field_comments import comment_on
from docs.repository_files import adapted, included, linked_path, outside_files, section

ROOT = Path(__file__).parents[1]
README = "# Title\n\nIntro.\n\n## One\n\nFirst.\n\n### Inside\n\nMore.\n\n## Two\n\nSecond.\n"


@pytest.mark.parametrize(
    ("link", "page", "path"),
    [
        ("../benchmarks/results/a.json", "docs/tuning.md", "benchmarks/results/a.json"),
        ("../../LICENSE", "docs/guides/python.md", "LICENSE"),
        ("runs.md", "docs/tuning.md", "docs/runs.md"),
        ("docs/runs.md", "README.md", "docs/runs.md"),
        ("https://github.com/google/brax", "README.md", None),
        ("", "README.md", None),
    ],
)
def test_what_a_link_points_to(link: str, page: str, path: str | None) -> None:
    assert linked_path(link, page) == path


@pytest.mark.parametrize(
    ("link", "source", "page", "on_site"),
    [
        ("../benchmarks/a.json", "docs/tuning.md", "docs/tuning.md", "benchmarks/a.json"),
        ("../../LICENSE", "docs/guides/x.md", "docs/guides/x.md", "../LICENSE"),
        ("runs.md#stop", "docs/tuning.md", "docs/tuning.md", "runs.md#stop"),
        ("docs/images/a.png", "README.md", "docs/index.md", "images/a.png"),
        ("docs/images/a.png", "README.md", "docs/results/index.md", "../images/a.png"),
        ("docs/guides/x.md", "CONTRIBUTING.md", "CONTRIBUTING.md", "guides/x.md"),
        ("../README.md", "docs/runs.md", "docs/runs.md", "index.md"),
        ("../README.md#results", "docs/runs.md", "docs/runs.md", "results/index.md"),
        ("#here", "docs/runs.md", "docs/runs.md", "#here"),
    ],
)
def test_links_are_adapted(link: str, source: str, page: str, on_site: str) -> None:
    assert adapted(f"a [text]({link}) b", source, page) == f"a [text]({on_site}) b"


def test_code_is_left_alone() -> None:
    text = "```python\nx = f[0](../y)\n```\n"

    assert adapted(text, "docs/a.md", "docs/a.md") == text


def test_sections() -> None:
    assert section(README, None).strip() == "Intro."
    assert section(README, "One").strip() == "First.\n\n### Inside\n\nMore."
    assert section(README, "Two").strip() == "Second."
    with pytest.raises(ValueError, match=r"'Three' .*One, Two"):
        section(README, "Three")


def test_the_results_page_holds_the_readmes_table() -> None:
    page = included((ROOT / "docs/results/index.md").read_text(), "docs/results/index.md")

    rows = [line for line in (ROOT / "README.md").read_text().splitlines() if "| emrld |" in line]
    assert rows
    assert all(row in page for row in rows)
    assert "(docs/" not in page


def test_all_that_pages_link_to_is_found() -> None:
    pages = [str(path.relative_to(ROOT)) for path in (ROOT / "docs").rglob("*.md")]
    linked = {
        name
        for page in pages
        for name in re.findall(r"benchmarks/results/([^)\s#]+)\)", (ROOT / page).read_text())
    }

    assert linked
    assert {f"benchmarks/results/{name}" for name in linked} <= set(outside_files(pages))


@pytest.mark.parametrize(
    ("lines", "first", "last", "comment"),
    [
        (["x: int  # [M], m"], 1, 1, "[M], m"),
        (["# above", "# it", "x: int"], 3, 3, "above it"),
        (["y: int  # not this", "x: int"], 2, 2, ""),
        (["x = f(", "    1,", ")  # s"], 1, 3, "s"),
        (['x = "a # b"'], 1, 1, ""),
    ],
)
def test_comments_of_fields(lines: list[str], first: int, last: int, comment: str) -> None:
    assert comment_on(lines, first, last) == comment


def test_the_guides_show_all_examples() -> None:
    """A formatter of code in Markdown must not have touched the lines that include them."""
    shown = {
        name
        for page in (ROOT / "docs").rglob("*.md")
        for name in re.findall(r'^--8<-- "([^":]+)', page.read_text(), re.MULTILINE)
    }

    assert {str(path.relative_to(ROOT)) for path in (ROOT / "examples").glob("*.py")} <= shown
