"""Used by every other folder, and imports none of them: settings, errors, the task registry, run folders, math."""
