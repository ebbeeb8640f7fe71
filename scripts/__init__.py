"""Scripts for users: ``python scripts/train.py`` in a checkout, ``python -m legged_torque.scripts.train`` anywhere."""
