"""Give bad input to every script and look how it is refused: ``python scripts/attack.py``.

Every setting and option with bad values, every kind of file damaged: about 4000 cases, in folders of their own, on a
CPU. A case is good if it is refused with exit status 2 and one line, and nothing is written, or may be accepted.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # cases are forks, which torch's threads do not survive

import random
import sys
import tempfile
from pathlib import Path

from legged_torque.utils.cli import Parser, check_at_least, check_output, run_script
from legged_torque.utils.files import write_json
from tools.attack import attack, table
from tools.attack_cases import all_cases
from tools.attack_fixture import make_fixture, parsers, warm_up

WORKERS = 2  # cases at a time
SHOW_EVERY = 200  # cases


def main() -> None:
    """Run the cases, print what was not good and a table, write JSON."""
    parser = Parser(__doc__)
    parser.add_argument("--only", help="only cases whose name contains this")
    parser.add_argument("--limit", type=int, help="at most so many cases, drawn at random; default: all")
    parser.add_argument("--seed", type=int, default=1, help="of all that is drawn; default: %(default)s")
    parser.add_argument("--json", type=Path, help="file to write: outcome and message of every case")
    args = parser.parse_args()
    if args.limit is not None:
        check_at_least(args, 1, "limit")
    if args.json:
        check_output(args.json)
    known = dict(parsers())
    warm_up()
    with tempfile.TemporaryDirectory(prefix="attack") as root:
        fixture = Path(root, "fixture")
        make_fixture(fixture)
        cases = [case for case in all_cases(fixture, known, args.seed) if (args.only or "") in case.name]
        if args.limit is not None and args.limit < len(cases):
            cases = random.Random(args.seed).sample(cases, args.limit)
        print(f"{len(cases)} cases", flush=True)
        results = []
        for result in attack(cases, fixture, *(Path(root, str(i)) for i in range(WORKERS))):
            results.append(result)
            if not result.is_good:
                print(f"{result.outcome}: {result.case.name}: {result.error.strip()[-160:]!r}", flush=True)
            if len(results) % SHOW_EVERY == 0:
                print(f"{len(results)} of {len(cases)}", flush=True)
    print(table(results))
    if args.json:
        keys = ("name", "script", "words", "outcome", "is_good", "error")
        rows = [(r.case.name, r.case.script, list(r.case.words), r.outcome, r.is_good, r.error) for r in results]
        write_json(args.json, {"seed": args.seed, "cases": [dict(zip(keys, row, strict=True)) for row in rows]})
    sys.exit(not all(result.is_good for result in results))


if __name__ == "__main__":
    run_script(main)
