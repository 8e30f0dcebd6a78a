"""Bad input over every command: each case states the exit codes that are right; `python -m tests.attack` runs them."""
