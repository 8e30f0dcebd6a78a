"""The terminal: tables and messages, remaining time, ranges of options."""
