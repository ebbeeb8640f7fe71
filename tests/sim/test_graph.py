"""Graphs of a GPU: when a function runs, is captured and is replayed."""

import pytest

from legged_torque.sim import graph


@pytest.fixture
def calls(monkeypatch):
    """A graph as on a GPU, with what it does noted in place of a GPU's work."""
    noted = []

    class Recorded:
        """A captured graph."""

        def replay(self):
            noted.append("replayed")

    class NotedGraph(graph.CudaGraph):
        """Captures by name only."""

        def _capture(self):
            noted.append("captured")
            return Recorded()

    monkeypatch.setattr(graph, "is_capturing", lambda device: False)
    return NotedGraph(lambda: noted.append("run"), "cuda:0"), noted


def test_graph_runs_captures_and_replays(calls):
    """The first call runs, the second captures, all replay from then on; a reset starts over."""
    function, noted = calls
    for _ in range(3):
        function()
    assert noted == ["run", "captured", "replayed", "replayed"]
    noted.clear()
    function.reset()
    for _ in range(2):
        function()
    assert noted == ["run", "captured", "replayed"]


def test_disabled_graph_runs(calls):
    """Nothing is captured while it is disabled, and nothing replayed that was captured before."""
    function, noted = calls
    function.enabled = False
    for _ in range(3):
        function()
    assert noted == ["run"] * 3
    function.enabled = True
    function()
    function.enabled = False
    function()
    assert noted[3:] == ["captured", "replayed", "run"]


def test_graph_inside_another_one_runs(calls, monkeypatch):
    """While another graph is being captured, a function runs and so becomes part of it."""
    function, noted = calls
    monkeypatch.setattr(graph, "is_capturing", lambda device: True)
    for _ in range(3):
        function()
    assert noted == ["run"] * 3
