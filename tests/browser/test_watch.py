"""The page that is served while runs go on shows what is new, and leaves its reader's choices alone."""

from __future__ import annotations

import threading

import pytest
from playwright.sync_api import expect
from report.synthetic import write_run

from saclab.report.watch import WatchedPage, server_of

from .test_page import browser, control, pytestmark  # noqa: F401 - the fixture, and no browser no test


@pytest.fixture
def served(tmp_path):
    with server_of(WatchedPage([tmp_path], every=0), 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


@pytest.mark.slow
def test_a_newer_page_comes_by_itself_and_keeps_the_choices(browser, served, tmp_path):  # noqa: F811
    for variant in ("sac", "averaged"):
        write_run(tmp_path, variant, 0)
    context = browser.new_context(viewport={"width": 1200, "height": 900})
    noise: list[str] = []
    context.on("console", lambda message: noise.append(message.text))
    page = context.new_page()
    page.set_default_timeout(60_000)
    page.goto(served)
    expect(page.locator(".lead")).to_contain_text("2 runs")
    control(page, "Averaged-SAC").uncheck()
    control(page, "updates").check()
    control(page, "single runs").uncheck()
    page.locator("#controls details summary").click()
    page.evaluate("scrollTo(0, 700)")
    read, height = place_of_first_figure(page), page.evaluate("document.body.scrollHeight")
    page.evaluate("window.before = true")
    page.wait_for_timeout(3000)
    assert page.evaluate("window.before"), "a page of which nothing is new stays as it is"
    write_run(tmp_path, "sac", 1)
    expect(page.locator(".lead")).to_contain_text("3 runs")
    assert not page.evaluate("window.before")
    expect(control(page, "Averaged-SAC")).not_to_be_checked()
    expect(control(page, "SAC")).to_be_checked()
    expect(control(page, "updates")).to_be_checked()
    expect(control(page, "single runs")).not_to_be_checked()
    expect(control(page, "1")).to_be_checked()
    assert page.locator("#controls details").get_attribute("open") is not None
    assert page.evaluate("document.body.scrollHeight") > height, "more is said of two seeds than of one"
    assert place_of_first_figure(page) == pytest.approx(read, abs=2), "what is read stays where it is on the screen"
    assert page.locator("figure > svg path.middle.a1").count() == 0, "what is drawn is what is chosen"
    context.close()
    assert noise == []


def place_of_first_figure(page) -> float:
    return page.locator("figure").first.evaluate("figure => figure.getBoundingClientRect().top")
