"""`swimm3r bench PROTOCOL`: the paper's tables on your own dives, one sub-command each."""
