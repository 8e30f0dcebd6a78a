"""Many dives by one command: found or listed in a table, run side by side, and shown on one page."""
