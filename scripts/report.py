"""Report on an experiment or on runs: ``python scripts/report.py logs/experiments/low``.

Takes the folder of an experiment, a folder with runs of train.py (logs/a1_torque, or all of logs), or a single run.
"""

from pathlib import Path

from legged_torque.paper.report import check_extra
from legged_torque.utils import cli
from legged_torque.utils.errors import counted
from legged_torque.utils.files import path_inside
from legged_torque.utils.limits import NotNegative


def main() -> None:
    """Read the results, draw figures, write tables and the report: as Markdown, and as one page for a browser."""
    parser = cli.Parser(__doc__)
    parser.add_argument("experiment", type=Path, help="folder of experiment.py's results, or with runs of train.py")
    hint = "folder for the report, its tables and figures; default: report, in the folder of the results"
    parser.add_argument("--out", type=Path, help=hint)
    hint = "step from which evaluations count; default: the last 18%% of a training: "
    hint += "from 90 of 110 million, as in Table I"
    parser.add_argument("--from_step", type=float, help=hint)
    hint = "folder with videos <task>.mp4, .webm or .gif, to be shown in the page"
    parser.add_argument("--videos", type=Path, help=hint)
    args = parser.parse_args()
    cli.check_args(args, from_step=NotNegative)
    out = args.out or path_inside(args.experiment, "report")
    cli.check_output(out / "report.md")
    cli.check_output(out / "report.html")
    with cli.slow_imports():
        check_extra()
        from legged_torque.paper.report.experiment import read_experiment
        from legged_torque.paper.report.report import find_videos, write_report
    experiment = read_experiment(args.experiment)
    videos = find_videos(args.videos, experiment.plan.tasks) if args.videos else {}
    from_step = experiment.last_part() if args.from_step is None else args.from_step
    figures, missing = write_report(experiment, from_step, out, videos)
    lines = counted(missing, "line")
    print(f"{out / 'report.md'}, report.html, {counted(figures, 'figure')}; missing or not finished: {lines}")


if __name__ == "__main__":
    cli.run_script(main)
