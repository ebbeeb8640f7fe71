"""The paper's approaches: task classes and settings that name no robot."""
