"""Examples have tests of their own; tests/utils/test_own_tasks.py runs them apart from the library's."""

collect_ignore_glob = ["*"]
