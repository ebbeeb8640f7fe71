"""What every part uses: configuration, errors, the task registry, run folders, math. Imports no other part."""
