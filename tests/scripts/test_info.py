"""The script that shows what is installed."""

import torch
from support.scripts import run_here


def test_info(tmp_path):
    """Versions, device, the folder of kernels, and renderers; nothing is written."""
    status, output, _ = run_here("info.py", root=tmp_path)
    assert status == 0 and f"  torch          {torch.__version__}\n" in output and "compiled kernels: " in output
    for title in ("versions", "machine", "GPU", "caches", "extras", "rendering"):
        assert f"\n{title}\n  " in output
    assert not list(tmp_path.iterdir())
