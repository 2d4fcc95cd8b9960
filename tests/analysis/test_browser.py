"""The report in a real browser: what is drawn, moved, sorted and chosen, and no error."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from emrld_jax.analysis.groups import group_runs
from emrld_jax.analysis.loading import load_runs
from emrld_jax.analysis.page import write_report
from tests.analysis.conftest import write_run
from tests.browser import (
    SIZES,
    assert_no_scrolling_sideways,
    browser,
    needs_chromium,
    set_size,
)

LONG = f"{'a_very_long_name_' * 5}.npz"

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of three algorithms on two environments, one with a long name of demonstrations."""
    folder = tmp_path_factory.mktemp("report")
    for environment in ("point2d", "two_wheeled"):
        for algo, value in (("emrld", 70.0), ("emrld_ws", 90.0), ("maml", 20.0)):
            for seed in (0, 1):
                write_run(
                    folder / "runs" / environment / algo / f"seed{seed}",
                    environment=environment,
                    algo=algo,
                    seed=seed,
                    value=value + 5 * seed,
                    seconds=1.5 + seed,
                    episodes=True,
                    **({"demos": LONG} if environment == "two_wheeled" else {}),
                )
    write_run(folder / "runs" / "cut", seed=5)
    (folder / "runs" / "cut" / "results.json").unlink()
    write_report(group_runs(load_runs([folder / "runs"])), folder / "report.html")
    return folder / "report.html"


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The browser, for all tests."""
    with browser(tmp_path_factory.mktemp("browser")) as driver:
        yield driver


def open_page(chromium: Any, report: Path, size: str) -> int:
    """Opens a report in a window as large as one of SIZES; its width in pixels."""
    width = set_size(chromium, size)
    chromium.get(report.as_uri())
    return width


@pytest.fixture(params=SIZES)
def page(request: pytest.FixtureRequest, chromium: Any, report: Path) -> Iterator[Any]:
    """The report, opened; at the end the console must hold no word."""
    width = open_page(chromium, report, request.param)
    yield chromium
    assert chromium.get_log("browser") == []
    assert_no_scrolling_sideways(chromium, width)  # nothing but the tables does


def find(page: Any, selector: str) -> Any:
    return page.find_element("css selector", selector)


def text(page: Any, selector: str) -> str:
    return str(page.execute_script(f"return document.querySelector('{selector}').textContent"))


def press(page: Any, selector: str) -> None:
    """A click, as by a user: what is covered or not there cannot be clicked."""
    node = find(page, selector)
    page.execute_script("arguments[0].scrollIntoView({block: 'center', inline: 'center'})", node)
    node.click()


def drawn(page: Any, place: str) -> list[str]:
    """All lines that are drawn at a place."""
    script = f"return [...document.querySelectorAll('{place} path')].map(p => p.getAttribute('d'))"
    return list(page.execute_script(script))


def column(page: Any, table: str, number: int) -> list[str]:
    script = (
        f"return [...document.querySelectorAll('#{table} tbody tr')]"
        f".map(row => row.cells[{number}].textContent)"
    )
    return list(page.execute_script(script))


def test_what_is_told_at_the_start(page: Any) -> None:
    assert "12 runs in 6 lines" in text(page, "#summary")
    assert "cut: interrupted or still training" in text(page, "#skipped")
    assert "fewer than 4 seeds" in text(page, "#remarks")
    assert "emrld (2 seeds)" in text(page, "#curve-grid .legend")
    assert len(drawn(page, "#curve-grid .figure")) > 6
    for link in page.find_elements("css selector", "#run-list a"):
        assert Path(link.get_property("href").removeprefix("file://")).is_file()


def test_the_slider_moves_through_the_iterations(page: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    slider, pictures = find(page, "#moment"), "#moment-paths .figure:last-child"
    page.execute_script("arguments[0].scrollIntoView({block: 'center'})", slider)
    assert text(page, "#moment-words") == "meta-iteration 4"
    last = drawn(page, pictures)
    slider.send_keys(Keys.ARROW_LEFT)
    assert text(page, "#moment-words") == "meta-iteration 2"
    middle = drawn(page, pictures)
    slider.send_keys(Keys.HOME)
    assert text(page, "#moment-words") == "before training"
    first = drawn(page, pictures)
    assert len({tuple(moment) for moment in (first, middle, last)}) == 3
    before = "#moment-paths .figure:first-child"
    assert drawn(page, before)  # demonstrations at least
    assert "reward found in 0 of 2 tasks" in text(page, before)
    slider.send_keys(Keys.END)
    assert drawn(page, pictures) == last
    assert "reward found in 2 of 2 tasks" in text(page, pictures)


def test_the_paths_of_another_run_and_split(page: Any) -> None:
    final = drawn(page, "#final-paths")
    assert final
    assert "held-out tasks" in text(page, "#final-paths")
    press(page, "#final-split button[data-value=train]")
    assert "training tasks" in text(page, "#final-paths")
    # goals are the same points in both environments here, but the reward zones are not
    assert "0.2 m from the goal" in text(page, "#path-words")
    zone = "return document.querySelector('#moment-paths circle.zone').getAttribute('r')"
    small = float(page.execute_script(zone))
    press(page, "#drawn-run option:last-child")
    assert float(page.execute_script(zone)) > 1.5 * small


def test_tables_sort(page: Any) -> None:
    heading = "#results th:nth-child(4)"
    returns = [cell.split(" ")[0] for cell in column(page, "results", 3)]
    assert sorted(returns) == ["12.5", "12.5", "62.5", "62.5", "82.5", "82.5"]
    press(page, f"{heading} button")
    down = [float(cell.split(" ")[0]) for cell in column(page, "results", 3)]
    assert down == [82.5, 82.5, 62.5, 62.5, 12.5, 12.5]
    assert find(page, heading).get_attribute("aria-sort") == "descending"
    press(page, f"{heading} button")
    assert [float(cell.split(" ")[0]) for cell in column(page, "results", 3)] == down[::-1]
    press(page, "#results th:first-child button")
    names = page.execute_script(
        "return [...document.querySelectorAll('#results tbody tr')]"
        ".map(row => row.cells[0].querySelector('span').firstChild.textContent)"
    )
    assert names == ["emrld", "emrld", "emrld_ws", "emrld_ws", "maml", "maml"]


def test_the_results_fit_on_a_desktop(chromium: Any, tmp_path: Path) -> None:
    """Large numbers, long names, and returns below 0; on a phone the table scrolls in its box."""
    for algo, value in (("emrld_ws", -1234.5), ("maml", 310.5)):
        for seed in range(2):
            own: dict[str, Any] = {"environment": "two_wheeled_drift", "demos": LONG}
            path = tmp_path / algo / str(seed)
            write_run(path, seed=seed, value=value + 31.0 * seed, algo=algo, **own)
    write_report(group_runs(load_runs([tmp_path])), tmp_path / "report.html")
    widths = (
        "const box = document.querySelector('#results').parentElement;"
        "return [box.clientWidth, box.scrollWidth, document.documentElement.scrollWidth]"
    )
    open_page(chromium, tmp_path / "report.html", "desktop")
    seen, whole, _ = chromium.execute_script(widths)
    assert 900 < whole <= seen
    assert "-1219.0 [-1234.5, -1203.5]" in column(chromium, "results", 6)
    open_page(chromium, tmp_path / "report.html", "phone")
    seen, whole, page = chromium.execute_script(widths)
    assert seen < whole
    assert page <= SIZES["phone"][0]


def test_a_bar_holds_returns_below_zero_too(chromium: Any, tmp_path: Path) -> None:
    """Its left end is the lowest return, its right end the demonstrations' (80)."""
    write_run(tmp_path / "a", value=-70.0)  # -80 on held-out tasks
    write_run(tmp_path / "b", value=10.0, algo="gmps")
    write_report(group_runs(load_runs([tmp_path])), tmp_path / "report.html")
    open_page(chromium, tmp_path / "report.html", "desktop")
    places = "return [...document.querySelectorAll('#results {}')].map(n => +n.getAttribute('{}'))"
    dots = chromium.execute_script(places.format(".dot", "cx"))
    starts, ends, shown = (
        chromium.execute_script(places.format(f".{name}", end))
        for name, end in (("rule", "x1"), ("rule", "x2"), ("reference", "x1"))
    )
    assert dots == [starts[0], (starts[1] + ends[1]) / 2]  # 0 is in the middle of -80 and 80
    assert shown == ends


def test_demonstrations_of_another_reward_are_not_shown(chromium: Any, tmp_path: Path) -> None:
    write_run(tmp_path / "a", value=-60.0, env__reward="dense")
    write_report(group_runs(load_runs([tmp_path])), tmp_path / "report.html")
    open_page(chromium, tmp_path / "report.html", "desktop")
    assert column(chromium, "results", 1) == ["point2d (dense reward) optimal"]
    assert column(chromium, "results", 4) == ["\u2013"]
    assert not chromium.find_elements("css selector", "#results .reference")
    assert chromium.get_log("browser") == []


def test_curves_against_other_axes(page: Any) -> None:
    seen = {"meta-iterations": drawn(page, "#curve-grid")}
    for axis, words in (("env_steps", "environment steps"), ("seconds", "seconds")):
        press(page, f"#axis button[data-value={axis}]")
        assert words in text(page, "#curve-grid svg")
        assert (
            find(page, f"#axis button[data-value={axis}]").get_attribute("aria-pressed") == "true"
        )
        seen[words] = drawn(page, "#curve-grid")
    assert seen["seconds"] != seen["environment steps"]
    press(page, "#measure button[data-value=success]")
    assert "100%" in text(page, "#curve-grid svg")
    with_seeds = len(drawn(page, "#curve-grid"))
    press(page, "#each")
    assert len(drawn(page, "#curve-grid")) == with_seeds - 12  # six lines of two seeds


def test_settings_and_comparison(page: Any) -> None:
    assert column(page, "setting-values", 0) == ["algo", "env.name"]
    assert page.find_elements("css selector", "#setting-values td.unlike")
    press(page, "#all-settings")
    assert "policy.hidden_sizes" in column(page, "setting-values", 0)
    comparison = text(page, "#comparison")
    assert "emrld > maml" in comparison
    assert f"point2d, optimal + two_wheeled, {LONG[:-4]}" in comparison
    press(page, "#problem option:last-child")
    assert "(2 seeds)" in text(page, "#comparison")
