"""The report against the paper, numbers by hand, and as a page: whole, escaped, and with nothing from elsewhere."""

import base64
import copy
import itertools
import re

import pytest
from support.reports import HEADER, SETTINGS, Page, line, run_script, write_experiment, write_part

from legged_torque.experiments.times import Times, write_times
from legged_torque.paper.report import figures, figures_curves, figures_style
from legged_torque.paper.report.against_paper import best_torque, count, judge
from legged_torque.paper.report.blocks import Code, Grid, Paragraph
from legged_torque.paper.report.results import Summary, read_experiment, summarize
from legged_torque.paper.values import ENVIRONMENTS, PAPER_METRICS, PAPER_TASKS, paper_column
from legged_torque.utils.metrics import METRICS

METRIC = {metric.name: metric for metric in METRICS}
EVIL = "</code></pre><script>alert(1)</script> <img src=http://evil.example/x.png> & `x` | **y**"


@pytest.mark.parametrize(
    ("name", "values", "paper", "sign", "share"),
    [
        ("track_percentage", [0.80, 0.82], 0.79, "✓", 0.02 / 0.79),  # 0.81 ± 0.01
        ("track_percentage", [0.80, 0.82], 0.815, "≈", -0.005 / 0.815),
        ("track_percentage", [0.80, 0.82], 0.83, "✗", -0.02 / 0.83),
        ("track_xy", [0.03, 0.05], 0.06, "✓", 1 / 3),  # 0.04 ± 0.01: low is good
        ("track_xy", [0.03, 0.05], 0.035, "≈", -1 / 7),
        ("track_xy", [0.03, 0.05], 0.02, "✗", -1.0),
        ("collision_force", [130.0], 131.0, "✓", 1 / 131),  # one seed: no error
        ("collision_force", [130.0], 130.0, "≈", 0.0),
    ],
)
def test_judge(name, values, paper, sign, share):
    """Better or worse by more than the standard error, in the metric's own direction."""
    verdict = judge(METRIC[name], Summary(values), paper)
    assert verdict.sign == sign and verdict.share == pytest.approx(share)


def test_no_direction():
    """Neither a high nor a low trunk is better."""
    with pytest.raises(ValueError, match="neither direction of height is better"):
        METRIC["height"].gain(0.3, 0.2)


@pytest.fixture
def papers_table():
    """A table with the paper's own numbers, from two seeds that differ by a hundredth of them."""
    table = {column: {task: {} for task in PAPER_TASKS} for column in ENVIRONMENTS}
    for column, metric in itertools.product(ENVIRONMENTS, PAPER_METRICS):
        for task, paper in paper_column(column, metric.name).items():
            table[column][task][metric.name] = Summary([0.995 * paper, 1.005 * paper])
    return table


def test_count(papers_table):
    """Every number counts once; those that are missing are not good."""
    start = "**80 of 80 numbers are at least as good as the paper's within one standard error** of ours: "
    assert count(papers_table) == start + "0 are better, 80 within it, 0 worse, 0 missing."
    papers_table["low"]["a1_position"]["track_xy"] = Summary([0.03])
    papers_table["high"]["a1_position"]["track_xy"] = Summary([0.06])
    del papers_table["doubled"]["a1_multihead"]["cost_of_transport"], papers_table["high_frequency"]["a1_multihead"]
    papers_table["low"]["a1_torque"] = {"track_xy": Summary([9.0])}  # not in Table I
    assert "**73 of 80" in count(papers_table)
    assert count(papers_table).endswith("1 are better, 72 within it, 1 worse, 6 missing.")


def test_best_torque_methods(papers_table):
    """The best mean of all tasks but position, against the best of all models: 0.7866, 0.0316 and 135.1 in low."""
    low = papers_table["low"]
    low["a1_position"] = {"track_percentage": Summary([0.99])}
    low["a1_new"] = {"track_percentage": Summary([0.83, 0.85]), "track_xy": Summary([0.0310], is_final=False)}
    text, grid = best_torque({"low": low, "doubled": papers_table["doubled"]})
    rows = {(row[0], row[1]): row[2:] for row in grid.rows}
    assert len(rows) == len(grid.rows) == 15
    expected = ["0.7866 (Torque curriculum)", "`a1_new`", "0.8400 ± 0.0100 (2)", "✓ +6.8%"]
    assert rows["Track % [share]", "low"] == expected
    assert rows["Track xy [m²/s²]", "low"][1:] == ["`a1_new`", "0.0310 (1) †", "≈ +1.9%"]
    force = rows["Collision forces [N]", "low"]
    assert force[0] == "135.1 (PD)" and force[1] == "Torque curriculum" and force[3] == "✗ -0.7%"  # 136.0
    assert rows["Track % [share]", "high"][1:] == ["no data", "", ""]
    assert text.text.startswith("**In 1 of 15 rows the best torque method is better than the paper's best by 5%")


def markdown_tables(text):
    """The cells of all tables of a Markdown file without their marks."""
    tables, before = [], ""
    for each in text.splitlines():
        if each.startswith("| ") and not before.startswith("| "):
            tables.append([])
        if each.startswith("| ") and not each.startswith("| ---"):
            cells = re.split(r" \| ", each[2:-2])
            tables[-1].append([re.sub(r"`|\*\*", "", cell) for cell in cells])
        before = each
    return tables


@pytest.fixture
def folder(tmp_path):
    """An experiment with three seeds, one of which is bad, evaluated in doubled while it trained; texts are hostile."""
    folder = tmp_path / "paper"
    write_experiment(folder, {"high_frequency": ["high_frequency", "doubled"]}, (1, 2, 3), ["a1_position", "a1_new"])
    (folder / "experiment.yaml").write_text(f"# {EVIL}\n# ```\n" + (folder / "experiment.yaml").read_text())
    for task, tracking in {"a1_position": 0.70, "a1_new": 0.74}.items():
        for seed in (1, 2, 3):
            run = folder / f"{task}-high_frequency-s{seed}" / "2026-01-01_00-00-00"
            settings = copy.deepcopy(SETTINGS) | {"device_name": f"GPU {EVIL}"}
            settings["env"]["control"] = {"what": task, "same": EVIL}
            write_part(run, [line(90, tracking), line(110, tracking + 0.01 * seed)], **settings)
            rows = [line(80, 0.1), line(90, tracking - 0.1), line(110, tracking - 0.1 + 0.02 * seed)]
            (run / "evaluations_doubled.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    (folder / "a1_new-high_frequency-s1" / "result_<script>&.json").write_text("{")
    return folder


@pytest.fixture
def written(folder, tmp_path, monkeypatch):
    """The report as Markdown and as a page that was read, with figures that are a byte each."""

    def draw(experiment, table, out):
        (out / "figure3.png").write_bytes(b"\x89")
        return ["Figure 3"]

    monkeypatch.setattr(figures, "draw_all", draw)
    (tmp_path / "videos").mkdir()
    for name in ("a1_new.mp4", "a1_position.gif", "a1_other.mp4", "a1_new.txt"):
        (tmp_path / "videos" / name).write_bytes(name.encode())
    assert run_script(folder, "--out", tmp_path / "out", "--videos", tmp_path / "videos") == 0
    text = (tmp_path / "out" / "report.html").read_text()
    return (tmp_path / "out" / "report.md").read_text(), text, Page(text)


def test_evaluations_in_doubled_count(folder):
    """Table I's doubled column has the mean of the evaluations from step 90 million on, of each seed."""
    table = summarize(read_experiment(folder), 90e6)
    assert table["doubled"]["a1_position"]["track_percentage"].values == pytest.approx([0.61, 0.62, 0.63])
    assert table["high_frequency"]["a1_position"]["track_percentage"].values == pytest.approx([0.705, 0.71, 0.715])


def test_tables_are_the_same_in_both(written):
    """The first two tables are against the paper, and the page has the cells of the Markdown, in the signs' colours."""
    text, _, page = written
    assert page.tables == markdown_tables(text) and len(page.tables) > 5
    assert re.findall(r"^## (.*)", text, re.M)[:2] == ["Table I", "Best torque method against the paper's best"]
    assert page.tables[1][0] == ["metric", "method", "high_frequency", "paper", "doubled", "paper"]
    assert page.tables[1][1][:2] == ["Track % [share]", "PD"] and page.tables[1][2][:2] == ["", "a1_new"]
    assert page.tables[1][1][2:] == ["✗ 0.7100 ± 0.0029", "0.7163", "✗ 0.6200 ± 0.0058", "0.6765"]
    assert {"better", "within", "worse", None} == set(page.kinds)


def test_the_page_is_whole(written):
    """It refers to nothing but itself: pictures and videos are in it, byte by byte, links lead to its own headings."""
    text, source, page = written
    data = [reference.partition(",")[::2] for reference in page.references if reference.startswith("data:")]
    assert {kind: base64.b64decode(content) for kind, content in data} == {
        "data:image/png;base64": b"\x89",
        "data:video/mp4;base64": b"a1_new.mp4",
        "data:image/gif;base64": b"a1_position.gif",
    }
    links = [reference for reference in page.references if not reference.startswith("data:")]
    assert len(links) > 5 and all(f'id="{link.removeprefix("#")}"' in source for link in links)
    assert "@import" not in source and "url(" not in source and "![Figure 3](figure3.png)" in text
    assert 'name="viewport"' in source and "prefers-color-scheme: dark" in source


def test_texts_from_files_are_escaped(written):
    """Whatever stands in them is shown as it is: no tag of theirs, and no fence of theirs ends the plan."""
    text, source, page = written
    assert "<script" not in source and source.count("<img") == 2
    shown = EVIL.replace("`", "").replace("**", "")
    assert f"GPU {shown}" in page.text and f"# {EVIL}" in page.text and "result_<script>&.json" in page.text
    assert "\n````yaml\n# <" in text.replace("# </code>", "# <") and "\n````\n\nTo repeat it:" in text


def test_settings_and_times(folder, written):
    """Settings that differ between tasks, devices, and how long it took: six trainings of 110.5 s, 110e6 steps each."""
    text, _, page = written
    assert "| `env.control.what` | a1_position | a1_new |" in text and "`env.control.same`" not in text
    assert "All settings of a1_new" in page.text and "same: " in page.text and "All settings of" not in text
    times = "6 trainings took 0:11:03 in all, with their evaluations: 110.5 s and 0.995 million steps/s each on average"
    assert f"- {times}" in text and "GPU time" not in text
    write_times(folder / "a1_new-high_frequency-s1", Times(110_000_000, {"gpu training": 55.0}))
    assert run_script(folder, "--out", folder / "out") == 0
    assert "0:00:55 of GPU time for training; 110000000 steps" in (folder / "out" / "report.md").read_text()


def test_curves_over_seconds(folder):
    """They end at the time of the last evaluation, those over steps at its steps; new tasks differ in their styles."""
    pytest.importorskip("matplotlib", reason="figures need matplotlib: pip install -e .[plots]")
    experiment = read_experiment(folder)
    for title, end in {"Tracking": 110.0, "Tracking over seconds": 110.5}.items():
        (axis,) = figures_curves.draw_curves(experiment, figures.CURVES[title][1], title).axes
        lines = [each for each in axis.lines if each.get_label()[0] != "_"]
        assert [max(each.get_xdata()) for each in lines] == [end, end]
    tasks = ["a1_position", *(f"new_{number}" for number in range(6))]
    assert len({figures_style.style(tasks, task) for task in tasks}) == 7
    assert figures_style.style(tasks, "a1_position") == figures_style.STYLES["a1_position"]


@pytest.mark.parametrize("name", ["nowhere", "empty", "paper"])
def test_no_videos(folder, tmp_path, capsys, name):
    """A folder without a video of a task of the plan is a mistake."""
    (tmp_path / "empty").mkdir()
    assert run_script(folder, "--out", tmp_path / "out", "--videos", tmp_path / name) == 2
    assert "there is no video in '" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_blocks():
    """Marks, line breaks and fences stay what they are."""
    assert Grid(["a|b"], [["x\ny | z"]]).markdown() == "| a\\|b |\n| --- |\n| x y \\| z |"
    assert Paragraph("`a<b` and **c & d**").html() == "<p><code>a&lt;b</code> and <strong>c &amp; d</strong></p>"
    assert Code("a ```` b\n", "yaml").markdown() == "`````yaml\na ```` b\n`````"
    folded = Code("x", "yaml", "Title")
    assert folded.markdown() == "" and "<summary>Title</summary>" in folded.html()
