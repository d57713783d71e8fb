"""The whole report from made-up runs: what it holds, what it says, and that no name can break out of it."""

import csv
import json
import shlex
import subprocess
import sys
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest

from saclab.algorithm.metrics import METRICS
from saclab.errors import UserError
from saclab.protocols import make_config
from saclab.report import figures
from saclab.report.page import VIDEO_BYTES
from saclab.report.page_data import script_safe
from saclab.report.report import write_report
from saclab.report.sentences import ONE_SEED
from saclab.report.tables import latex_escape, markdown_escape
from saclab.report.train_command import train_command
from saclab.training.run_folder import read_run

from .synthetic import write_run

HOSTILE = "</script><script>boom()</script><!--<img src=x onerror=boom()>\"'`|$\\frac{&amp;\u2028\x00"


@pytest.fixture(autouse=True, scope="module")
def coarse_pictures():
    """Figures of few dots: here only their making is tested."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "DOTS_PER_INCH", 40)
        yield


class Page(HTMLParser):
    """The elements of a page, and the text of its scripts."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.scripts, self.text, self.inside = [], [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag in ("script", "style"):
            self.inside.append(tag)

    def handle_endtag(self, tag):
        if self.inside and tag == self.inside[-1]:
            self.inside.pop()

    def handle_data(self, data):
        (self.scripts if self.inside[-1:] == ["script"] else self.text).append(data)

    @property
    def data(self):
        return json.loads(self.scripts[0])

    @property
    def words(self):
        return " ".join("".join(self.text).replace("\u00a0", " ").split())


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Three variants, two environments, two seeds, cut short, one run unfinished, one with a video."""
    root = tmp_path_factory.mktemp("report")
    runs = [
        write_run(root, variant, seed, environment, overrides={"max_updates": 60_000}, level=5000 + 1500 * index,
                  finished=(variant, seed) != ("averaged", 1), q_bias=environment == "Humanoid-v4")
        for environment in ("HalfCheetah-v4", "Humanoid-v4")
        for index, variant in enumerate(("sac", "averaged", "averaged-auto")) for seed in (0, 1)
    ]  # fmt: skip
    add_video(runs[0], b"\x00\x01film")
    index = write_report(runs, root / "out")
    return index.parent, Page(index.read_text(encoding="utf-8"))


def add_video(run, content):
    (run / "best").mkdir()
    (run / "best" / "video.mp4").write_bytes(content)


def test_all_files_are_written(report):
    folder, _ = report
    assert {path.name for path in folder.iterdir()} == {"index.html", "report.md", "scores.csv", "table.tex", "figures"}
    kinds = ("panels", "diagnostics", "intervals", "improvement", "profiles")
    names = {f"{kind}-{name}" for kind in kinds for name in ("HalfCheetah-v4", "Humanoid-v4")}
    names |= {f"{kind}-all" for kind in ("intervals", "improvement", "profiles")}
    assert {path.name for path in (folder / "figures").iterdir()} == {
        f"{n}.{end}" for n in names for end in ("png", "svg")
    }


def test_summary_comes_first_and_counts_seeds(report):
    _, page = report
    words = page.words
    assert words.index("Summary") < words.index("Learning curves") < words.index("To reproduce")
    assert "2 seeds cannot tell" in words
    assert "beats" not in words[: words.index("All environments together")]
    assert "10,183" in words
    assert "paper, best (1 seed)" in words


def test_scaled_down_and_unfinished_are_said_everywhere(report):
    folder, page = report
    for said in ("Scaled down: 60,000 of 1,200,000 updates of the paper protocol", "1 of 6 runs unfinished"):
        assert said in page.words
        assert said in (folder / "report.md").read_text()
        assert said in (folder / "table.tex").read_text()


def test_page_asks_for_nothing_from_outside(report):
    _, page = report
    for tag, attributes in page.elements:
        assert tag not in ("link", "iframe", "object", "embed", "base")
        assert not any(name.startswith("on") or name == "style" for name in attributes)
        for name in ("src", "href"):
            assert attributes.get(name, "#").startswith(("#", "data:"))
    (policy,) = (attributes["content"] for tag, attributes in page.elements if "http-equiv" in attributes)
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy


def test_script_data_covers_every_run_and_panel(report):
    _, page = report
    data = page.data
    assert [environment["name"] for environment in data["environments"]] == ["HalfCheetah-v4", "Humanoid-v4"]
    titles = [[panel["title"] for panel in environment["panels"]] for environment in data["environments"]]
    known = ["temperature α", "policy entropy", "mean Q", "Q spread", "snapshot spread"]
    others = ["critic_loss", "temperature_loss", "target_mean"]
    assert titles[0][4:] == [*known, *others]
    assert titles[1][4:] == [*known, "Q bias", "Q bias, spread", *others]
    assert data["environments"][1]["panels"][titles[1].index("Q bias")]["arms"][0]["middle"][:2] == [0.5, 0.25]
    for environment in data["environments"]:
        for panel in environment["panels"]:
            assert [len(arm["runs"]) for arm in panel["arms"]] == [2, 2, 2]
            for arm in panel["arms"]:
                for axis in data["axes"]:
                    assert len(data["pool"][arm["x"][axis]]) == len(arm["middle"]) == len(arm["low"])
    test_panel = data["environments"][0]["panels"][3]
    assert {line["title"]: line["arm"] for line in test_panel["paper"]} == {
        "paper: sac": 0, "paper: averaged-sac": 1, "paper: sac-alpha-tuning": None,
    }  # fmt: skip
    assert "steps" in test_panel["paper"][0]["x"]
    assert "steps" not in data["environments"][1]["panels"][3]["paper"][0]["x"]


def test_scores_csv_has_a_line_per_run(report):
    folder, _ = report
    rows = list(csv.DictReader((folder / "scores.csv").open()))
    assert len(rows) == 12
    assert [rows[0][name] for name in ("environment", "variant", "name", "seed", "differs")] == [
        "HalfCheetah-v4", "sac", "sac", "0", "",
    ]  # fmt: skip
    assert float(rows[0]["final"]) < float(rows[0]["best"])
    assert sum(row["finished"] == "False" for row in rows) == 2


def test_svg_figures_are_well_formed_and_say_that_they_are_scaled_down(report):
    folder, _ = report
    for path in (folder / "figures").glob("*.svg"):
        assert "Scaled down" in path.read_text()  # matplotlib keeps the text of glyphs as comments
        ElementTree.parse(path)


@pytest.mark.parametrize("styles", [{}, {"sac": 0}, {"sac-alpha-tuning": 0}])
def test_no_two_of_the_papers_curves_look_alike(styles):
    handles = figures.draw_paper(figures.new_figure(1, 1).subplots(), "Humanoid-v4", styles)
    assert len(handles) == 3
    assert len({(line.get_color(), line.get_linestyle()) for line in handles.values()}) == 3


def test_video_is_embedded_if_small(report, tmp_path):
    _, page = report
    assert sum(tag == "video" for tag, _ in page.elements) == 1
    run = write_run(tmp_path)
    add_video(run, bytes(VIDEO_BYTES + 1))
    text = write_report([run], tmp_path / "out").read_text()
    assert "<video" not in text
    assert "Too large to embed (0.5 MB)" in text


def test_the_videos_of_a_page_have_a_limit_together(tmp_path):
    runs = [write_run(tmp_path, variant) for variant in ("sac", "sac-auto", "averaged", "averaged-auto")]
    for run in runs:
        add_video(run, bytes(VIDEO_BYTES))
    text = write_report(runs, tmp_path / "out").read_text()
    assert text.count("<video") == 2
    assert text.count("Too large to embed (0.5 MB)") == 2
    assert len(text) < 2e6


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    root = tmp_path_factory.mktemp("hostile")
    rename = {
        "environment": HOSTILE,
        "variant": HOSTILE,
        "protocol": HOSTILE,
        "environment_arguments": {HOSTILE: HOSTILE},
    }
    runs = [
        write_run(root, "sac", seed, name=name, rename=rename, versions={HOSTILE: HOSTILE}, overrides=overrides)
        for seed in (0, 1) for name, overrides in (("<b>&x", {}), ("y", {"snapshots": 2}))
    ]  # fmt: skip
    return write_report(runs, root / "out", allow_mixed=True).parent


def test_hostile_names_do_not_break_out_of_the_page(hostile):
    page = Page((hostile / "index.html").read_text(encoding="utf-8"))
    assert [tag for tag, _ in page.elements].count("script") == 2
    assert not any(tag in ("img", "b") for tag, _ in page.elements)
    assert "boom()" not in page.scripts[1]
    assert page.data["environments"][0]["name"].startswith("</script><script>boom()</script><!--<img")
    assert "<script>boom()" in page.words
    assert "</script" not in page.scripts[0]
    assert "<!--" not in page.scripts[0]


def test_hostile_names_do_not_break_the_other_files(hostile):
    assert "<script" not in (hostile / "report.md").read_text().replace("\\<script", "")
    assert "$\\frac" not in (hostile / "table.tex").read_text()
    assert len(list(csv.DictReader((hostile / "scores.csv").open()))) == 4
    for path in (hostile / "figures").iterdir():
        assert path.parent == hostile / "figures"
        if path.suffix == ".svg":
            assert not any("script" in element.tag for element in ElementTree.parse(path).iter())


def test_escapes():
    assert script_safe("</script><!--&\u2028") == "\\u003c/script\\u003e\\u003c!--\\u0026\\u2028"
    assert json.loads(script_safe(json.dumps(HOSTILE))) == HOSTILE
    assert markdown_escape("a|b<c>[d](e)`") == "a\\|b\\<c\\>\\[d\\](e)\\`"
    assert latex_escape("α_1 & 50% \\input{x}") == r"$\alpha$\_1 \& 50\% \textbackslash{}input\{x\}"


@pytest.mark.parametrize(
    "options",
    [
        {"evaluations": 0, "finished": False},
        {"evaluations": 1},
        {"evaluations": 1, "finished": False, "metrics": ()},
        {"evaluations": 3, "metrics": ("temperature",)},
        {"environment": "Pendulum-v1", "protocol": "quick", "level": -200.0},
    ],
)
def test_short_runs_and_missing_metrics_work(tmp_path, options):
    runs = [write_run(tmp_path, variant, **options) for variant in ("sac", "averaged")]
    told: list[str] = []
    page = Page(write_report(runs, tmp_path / "out", tell=told.append).read_text())
    assert "Summary" in page.words
    summary = [line.partition(": ")[2] for line in told]
    assert summary[0] == (ONE_SEED if options.get("evaluations", 1) else summary[0])
    assert all(sentence in page.words for sentence in summary)
    assert len(summary) >= 1
    assert "Probability that a run of the row" not in page.words  # one seed each: such a number would say nothing
    assert not list((tmp_path / "out" / "figures").glob("improvement-*"))
    if not options.get("finished", True):
        assert "2 of 2 runs unfinished" in page.words


def test_diagnostics_are_what_the_runs_have(tmp_path):
    """Known metrics by title, others by name; what no run has, or what is 0 in all, has no panel."""
    names = ("actor_loss", "temperature", "temperature_loss", "snapshot_spread", "reward_scale", "my_<metric>")
    zero = {"temperature_loss": 0.0, "snapshot_spread": 0.0}
    runs = [write_run(tmp_path, "sac", metrics=names, constants=zero),
            write_run(tmp_path, "averaged", metrics=names, constants={"temperature_loss": 0.0})]  # fmt: skip
    page = Page(write_report(runs, tmp_path / "out").read_text())
    (environment,) = page.data["environments"]
    panels = {panel["title"]: panel for panel in environment["panels"] if panel["group"] == "diagnostics"}
    assert list(panels) == ["temperature α", "snapshot spread", "reward_scale", "my_<metric>"]
    assert panels["reward_scale"]["meaning"] == METRICS["reward_scale"] != panels["my_<metric>"]["meaning"] == ""
    assert [len(arm["runs"]) for arm in panels["snapshot spread"]["arms"]] == [1, 1], "it is not 0 in all"
    drawn = (tmp_path / "out" / "figures" / "diagnostics-HalfCheetah-v4.svg").read_text()
    assert "reward_scale" in drawn
    assert "temperature_loss" not in drawn
    alone = Page(write_report(runs[:1], tmp_path / "alone").read_text())
    assert "snapshot spread" not in {panel["title"] for panel in alone.data["environments"][0]["panels"]}


def test_a_report_is_imported_without_jax():
    code = "import sys, saclab.report.report; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_run_without_any_log_works(tmp_path):
    run = write_run(tmp_path, finished=False)
    for name in ("metrics.jsonl", "episodes.csv", "evaluations.csv"):
        (run / name).unlink()
    assert "No run has an evaluation so far" in Page(write_report([run], tmp_path / "out").read_text()).words


def test_refusal_writes_nothing(tmp_path):
    runs = [write_run(tmp_path, "sac", 0), write_run(tmp_path, "sac", 1, overrides={"discount": 0.9})]
    with pytest.raises(UserError, match="discount"):
        write_report(runs, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_same_runs_same_report(tmp_path):
    runs = [write_run(tmp_path)]
    first, second = (write_report(runs, tmp_path / name).parent for name in ("a", "b"))
    for path in (file for file in first.rglob("*") if file.is_file()):
        assert path.read_bytes() == (second / path.relative_to(first)).read_bytes()


def test_commands_rebuild_the_configuration(tmp_path):
    plain = make_config("HalfCheetah-v4", "averaged", "paper", 3)
    assert train_command(plain) == "saclab train HalfCheetah-v4 --variant averaged --protocol paper --seed 3"
    changed = make_config(
        "Pendulum-v1", "sac-auto", "quick", 0, {"g": 9.0},
        {"hidden_layers": (8, 9), "max_updates": None, "max_steps": 5000},
    )  # fmt: skip
    assert train_command(changed) == (
        "saclab train Pendulum-v1 --variant sac-auto --protocol quick --seed 0 --environment-arguments '{\"g\": 9.0}' "
        "--hidden-layers 8 9 --max-steps 5000 --max-updates None"
    )
    hostile = read_run(write_run(tmp_path, rename={"variant": "x; rm -rf $(y)"})).config
    words = shlex.split(train_command(hostile))
    assert words[4] == "x; rm -rf $(y)"
    assert "--polyak-rate" in words
