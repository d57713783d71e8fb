"""The report in a real browser: what is clicked, hovered, typed, printed and played does what it says.

Needs a Chromium on the machine (Debian: `apt-get install chromium`); skipped without one. Nothing is downloaded.
"""

from __future__ import annotations

import re
import shutil

import imageio_ffmpeg
import numpy as np
import pytest
from playwright.sync_api import expect, sync_playwright
from report.synthetic import write_run

from saclab.report.report import write_report

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
         "--disable-background-networking", "--disable-component-update"]  # fmt: skip
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no chromium, chromium-browser or google-chrome in PATH to open the report with"
)
expect.set_options(timeout=60_000)  # a slow machine takes longer than the five seconds it has by itself

VARIANTS = ("sac", "averaged", "averaged-auto")
HACK = "</script><script>hacked=1</script><img src=x onerror=hacked=1>"
LONG = "W" * 78


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The page of three variants, two environments and two seeds, one run with a film of its best policy."""
    root = tmp_path_factory.mktemp("report")
    runs = [
        write_run(root, variant, seed, environment, level=5000 + 1500 * index)
        for environment in ("HalfCheetah-v4", "Humanoid-v4")
        for index, variant in enumerate(VARIANTS) for seed in (0, 1)
    ]  # fmt: skip
    write_video(runs[0] / "best" / "video.mp4")
    return write_page(runs, root / "out")


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A page whose names from run folders are scripts, or long without a space."""
    root = tmp_path_factory.mktemp("hostile")
    names = {"sac": HACK, "averaged": LONG}
    runs = [
        write_run(root, variant, seed, evaluations=5, name=f"<img src=x onerror=hacked=1> {variant}",
                  rename={"variant": name, "environment": "<img src=x onerror=hacked=1>-v0"})
        for variant, name in names.items() for seed in (0, 1)
    ]  # fmt: skip
    return write_page(runs, root / "out")


def write_page(runs, out):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("saclab.report.report.write_figures", lambda *_: None)  # their making is tested elsewhere
        return write_report(runs, out)


def write_video(path):
    """A second of grey that gets brighter, in the codec of `saclab record`."""
    path.parent.mkdir()
    writer = imageio_ffmpeg.write_frames(str(path), (64, 64), fps=12)
    writer.send(None)
    for frame in range(12):
        writer.send(np.full((64, 64, 3), 20 * frame, np.uint8))
    writer.close()


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def visit(browser):
    """`visit(path, **options)` opens a page in a fresh context; at the end it must have been quiet and offline."""
    visits = []

    def open_page(path, **options):
        context = browser.new_context(**{"viewport": {"width": 1200, "height": 900}} | options)
        noise, requests = [], []
        context.on("console", lambda message: noise.append(message.text))
        context.on("weberror", lambda error: noise.append(str(error.error)))
        context.on("request", lambda request: requests.append(request.url))
        page = context.new_page()
        page.set_default_timeout(60_000)
        page.goto(path.as_uri())
        visits.append((context, noise, requests, path.as_uri()))
        return page

    yield open_page
    for context, noise, requests, uri in visits:
        context.close()
        assert noise == []
        assert requests == [uri]


@pytest.fixture
def page(visit, report):
    return visit(report)


def data_of(page):
    """The numbers that the page draws."""
    return page.evaluate("JSON.parse(document.getElementById('data').textContent)")


def draw(page, kind, environment=0):
    return page.locator(f'[data-environment="{environment}"][data-draw="{kind}"]')


def control(page, title):
    return page.locator("#controls").get_by_label(title, exact=True)


def test_every_chart_is_drawn_without_an_error_or_a_request(page):
    data = data_of(page)
    for number, environment in enumerate(data["environments"]):
        for kind in ("curves", "diagnostics"):
            panels = [panel for panel in environment["panels"] if panel["group"] == kind]
            assert draw(page, kind, number).locator("figure > svg").count() == len(panels) > 0
        assert draw(page, "intervals", number).locator(".row").count() == 9
        assert draw(page, "profile", number).locator("path.middle").count() == 3
    assert draw(page, "intervals", "together").locator(".row").count() == 3
    assert page.locator("main .empty").count() == 0
    drawn = page.locator("main path[d], main line").evaluate_all(
        "nodes => nodes.map(node => [...node.attributes].map(a => a.value).join(' '))"
    )
    assert len(drawn) > 500
    assert not [text for text in drawn if re.search("NaN|undefined|Infinity", text)]


def test_each_variant_vanishes_and_returns(page):
    arms = [arm["title"] for arm in data_of(page)["arms"]]
    assert len(arms) == 3

    def marks():
        """Drawn marks of each variant, and the rows of numbers that name it."""
        return page.evaluate(
            "arms => arms.map((arm, place) => [document.querySelectorAll(`figure .a${place}`).length, "
            "[...document.querySelectorAll('.row')].filter(row => row.textContent.startsWith(`${arm}:`)).length])",
            arms,
        )

    everything = marks()
    assert all(curves > 50 and rows == 7 for curves, rows in everything)
    for place, arm in enumerate(arms):
        control(page, arm).click()
        assert marks() == [[0, 0] if other == place else count for other, count in enumerate(everything)]
        control(page, arm).click()
        assert marks() == everything
    for arm in arms:
        control(page, arm).focus()
        page.keyboard.press("Space")
    assert marks() == [[0, 0]] * 3
    assert (
        page.get_by_text("Nothing to show.").count()
        == page.locator("main figure:has(figcaption):not(:has(video))").count()
    )


def test_bands_and_papers_curves_can_be_switched_off(page):
    for title, mark in (("95 % bands", "path.band"), ("the paper's curves", "path.paper"), ("single runs", "path.run")):
        before = page.locator(f"figure {mark}").count()
        assert before > 0
        control(page, title).click()
        assert page.locator(f"figure {mark}").count() == 0
        control(page, title).click()
        assert page.locator(f"figure {mark}").count() == before


def test_seeds_can_be_switched_off(page):
    runs = page.locator("figure path.run")
    both = runs.count()
    page.locator("#controls summary").click()
    control(page, "0").click()
    assert runs.count() == both / 2 > 0
    control(page, "1").click()
    assert runs.count() == 0
    control(page, "0").click()
    control(page, "1").click()
    assert runs.count() == both


def label_value(text):
    """-1.5k -> -1500."""
    return float(text.rstrip("kM")) * {"k": 1e3, "M": 1e6}.get(text[-1], 1)


def texts(figure):
    """Axis labels of a chart: text, x, y, and where its anchor is."""
    return figure.locator("svg text").evaluate_all(
        "nodes => nodes.map(node => [node.textContent, +node.getAttribute('x'), +node.getAttribute('y'), "
        "node.getAttribute('text-anchor')])"
    )


def test_every_axis_changes_labels_and_ticks(page):
    data = data_of(page)
    figure, panel = draw(page, "curves").locator("figure").nth(3), data["environments"][0]["panels"][3]
    assert control(page, data["axes"][data["axis"]]).is_checked()
    seen = set()
    for key, title in reversed(data["axes"].items()):
        control(page, title).click()
        *ticks, label = [text for text, _, _, anchor in texts(figure) if anchor == "middle"]
        assert label == title
        values = [label_value(text) for text in ticks]
        x = [value for arm in panel["arms"] for value in data["pool"][arm["x"][key]]]
        assert len(values) >= 3
        assert values == sorted(set(values))
        assert min(x) <= values[0] < values[-1] <= max(x)
        assert values[-1] - values[0] > 0.5 * (max(x) - min(x))
        seen.add(tuple(ticks))
    assert len(seen) == 4


def number_shown(value):
    """As the page writes a number."""
    if abs(value) >= 100:
        return f"{np.floor(value + 0.5):,.0f}"
    return f"{float(f'{value:.3g}'):g}"


def readout_of(data, panel, x):
    """What the page should say at x, by variant."""
    lines = []
    for arm in panel["arms"]:
        place = data["pool"][arm["x"][data["axis"]]].index(x)
        middle, low, high = (number_shown(arm[name][place]) for name in ("middle", "low", "high"))
        lines.append(f"{data['arms'][arm['arm']]['title']}: {middle} [{low}, {high}], n = 2")
    return lines


def lines_shown(figure):
    return [line.replace("\u00a0", " ") for line in figure.locator(".readout > *").all_text_contents()]


def test_hover_reads_the_value_under_the_mouse(page):
    data = data_of(page)
    figure, panel = draw(page, "curves").locator("figure").nth(3), data["environments"][0]["panels"][3]
    figure.scroll_into_view_if_needed()
    picture, markers = figure.locator("svg"), figure.locator("path.marker.a0")
    every = 30 // 7
    for marker in (0, 3, 6):
        markers.nth(marker).hover(force=True)
        x = data["pool"][panel["arms"][0]["x"]["episodes"]][marker * every]
        head, *lines = lines_shown(figure)
        assert head == f"{x} training episodes"
        assert lines[:3] == readout_of(data, panel, x)
        begun = [line for line in panel["paper"] if data["pool"][line["x"]["episodes"]][0] <= x]
        assert sum(line.startswith("paper: ") for line in lines[3:]) == len(begun) == (0, 2, 3)[marker // 3]
    # The marker lies where the ticks of the axes put its value.
    place = markers.nth(3).evaluate("node => node.getAttribute('transform')")
    at_x, at_y = map(float, re.findall(r"-?[\d.]+", place))
    marks = texts(figure)[:-1]
    across = [(px, label_value(text)) for text, px, _, anchor in marks if anchor == "middle"]
    upward = [(py - 4, label_value(text)) for text, _, py, anchor in marks if anchor == "end"]
    assert np.polyval(np.polyfit(*zip(*across), 1), at_x) == pytest.approx(10 * (3 * every + 1), abs=0.5)
    value = panel["arms"][0]["middle"][3 * every]
    assert np.polyval(np.polyfit(*zip(*upward), 1), at_y) == pytest.approx(value, rel=0.01)
    box = picture.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] - 60)
    assert lines_shown(figure) == []


def test_hover_names_the_single_run_under_the_mouse(page):
    data = data_of(page)
    figure, panel = draw(page, "curves").locator("figure").nth(3), data["environments"][0]["panels"][3]
    figure.scroll_into_view_if_needed()
    run = panel["arms"][2]["runs"][1]
    start = figure.locator("path.run.a2").nth(1).get_attribute("d")[1:].split("L")[20]
    x, y = map(float, start.split())
    box, width = (
        figure.locator("svg").bounding_box(),
        figure.locator("svg").evaluate("node => node.viewBox.baseVal.width"),
    )
    page.mouse.move(box["x"] + x * box["width"] / width, box["y"] + y * box["width"] / width)
    title = data["arms"][2]["title"]
    assert lines_shown(figure)[-1] == f"single run: {title}, seed 1: {number_shown(run['y'][20])}"


def test_arrow_keys_read_the_values(page):
    data = data_of(page)
    figure, panel = draw(page, "curves").locator("figure").nth(3), data["environments"][0]["panels"][3]
    x = data["pool"][panel["arms"][0]["x"]["episodes"]]
    figure.focus()
    for key, place in (("ArrowRight", 0), ("ArrowRight", 1), ("ArrowLeft", 0), ("ArrowLeft", 0), ("PageDown", 10),
                       ("End", -1), ("ArrowRight", -1), ("ArrowLeft", -2), ("Home", 0)):  # fmt: skip
        page.keyboard.press(key)
        head, *lines = lines_shown(figure)
        assert head == f"{x[place]} training episodes"
        assert lines[:3] == readout_of(data, panel, x[place])
    page.keyboard.press("Escape")
    assert lines_shown(figure) == []
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Tab")
    assert lines_shown(figure) == []


def test_film_loads_and_plays_on_click(page):
    film = page.locator("video")
    assert film.count() == 1
    if not film.evaluate("node => node.canPlayType('video/mp4; codecs=\"avc1.640028\"')"):
        pytest.skip("this Chromium was built without H.264")
    film.scroll_into_view_if_needed()
    page.wait_for_function("document.querySelector('video').readyState >= 1")
    assert film.evaluate("node => [node.error, node.paused, node.videoWidth]") == [None, True, 64]
    assert film.evaluate("node => node.duration") == pytest.approx(1, abs=0.1)
    film.click()
    page.wait_for_function("() => { const film = document.querySelector('video'); "
                           "return !film.paused && film.currentTime > 0.1; }")  # fmt: skip
    film.click()
    page.wait_for_function("document.querySelector('video').paused")


def background(page):
    return page.evaluate("getComputedStyle(document.body).backgroundColor")


def test_colour_scheme_follows_the_system(page):
    colours = []
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        colours.append(background(page))
    assert colours[0] == "rgb(255, 255, 255)"
    assert max(map(int, re.findall(r"\d+", colours[1]))) < 60


REDRAWN = """() => [...document.querySelectorAll("figure > svg")].every(
    node => Math.abs(node.getBoundingClientRect().width / node.viewBox.baseVal.width - 1) <= 0.01)"""


@pytest.mark.parametrize("name", ["report", "hostile"])
def test_page_is_never_wider_than_the_window(visit, request, name):
    page = visit(request.getfixturevalue(name))
    page.evaluate("() => { for (const node of document.querySelectorAll('details')) node.open = true; }")
    for width, scheme in ((390, "light"), (820, "dark"), (1400, "light")):
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size({"width": width, "height": 800})
        wide = page.evaluate("[document.documentElement.scrollWidth, document.body.scrollWidth]")
        assert max(wide) <= width
        assert page.locator("figure > svg").count() > 0
        page.wait_for_function(REDRAWN)  # for this width, not stretched; it happens a moment after the change


def test_print_has_no_controls(page):
    control(page, "Averaged-SAC").focus()
    page.emulate_media(media="print", color_scheme="dark")
    assert background(page) == "rgb(255, 255, 255)"
    for part in ("input", "button", ".skip", "#controls details", ".readout", "video"):
        assert page.locator(part).count() > 0
        assert page.locator(f"{part} >> visible=true").count() == 0
    expect(page.locator("#controls")).to_contain_text("Averaged-SAC")  # what remains of them is the legend
    assert page.locator("main details[open]").count() == 0
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.locator("main details:not([open])").count() == 0


def test_keyboard_leads_to_what_the_controls_do_not_cover(page):
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")

    def top(node):
        return node.evaluate("node => node.getBoundingClientRect().top")

    controls = page.locator("#controls").bounding_box()
    assert controls["y"] == 0  # they stick there
    assert top(page.locator("#summary h2")) >= controls["height"] - 1
    figures = draw(page, "curves").locator("figure")
    figures.nth(3).evaluate("node => node.scrollIntoView()")
    figures.nth(3).focus()
    page.keyboard.press("Shift+Tab")
    expect(figures.nth(2)).to_be_focused()
    page.keyboard.press("Shift+Tab")
    expect(figures.nth(1)).to_be_focused()
    assert top(figures.nth(1)) >= controls["height"] - 1


def test_commands_are_copied_or_selected(visit, report):
    page = visit(report, permissions=["clipboard-read", "clipboard-write"])
    page.locator("#copy").click()
    expect(page.locator("#copy")).to_have_text("Copied")
    commands = page.locator("#commands").text_content()
    assert commands.count("saclab train ") == 12
    assert page.evaluate("navigator.clipboard.readText()") == commands
    page.evaluate("() => { navigator.clipboard.writeText = () => Promise.reject(); }")
    page.locator("#copy").click()
    expect(page.locator("#copy")).to_have_text("Selected: press Ctrl-C")
    assert page.evaluate("getSelection().toString()").strip() == commands.strip()


def test_without_scripts_the_tables_stay_and_say_where_the_pictures_are(visit, report):
    page = visit(report, java_script_enabled=False)
    expect(page.locator("noscript p")).to_contain_text("the same curves lie as pictures")
    assert page.get_by_role("row", name=re.compile("^Averaged-SAC ")).first.is_visible()


@pytest.mark.parametrize("bypass_csp", [False, True])
def test_hostile_names_are_text(visit, hostile, bypass_csp):
    """With the page's content security policy and without: the escaping alone must hold."""
    page = visit(hostile, bypass_csp=bypass_csp)
    title = data_of(page)["arms"][0]["title"]
    assert title == HACK
    assert control(page, title).is_checked()
    figure = draw(page, "curves").locator("figure").first
    figure.focus()
    page.keyboard.press("End")
    assert lines_shown(figure)[1].startswith(f"{HACK}: ")
    for place in (page.locator("h2"), draw(page, "intervals"), page.locator("#commands")):
        assert "<img src=x onerror=hacked=1>" in " ".join(place.all_text_contents())
    assert page.locator("img").count() == 0
    assert page.locator("script").count() == 2
    assert page.evaluate("typeof window.hacked") == "undefined"
