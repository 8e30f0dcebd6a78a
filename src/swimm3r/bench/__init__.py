"""The paper's protocols: each fills cells (scene x method x seed -> scores) and prints them as its table.

cells.py        a cell, kept on disk and not computed twice; scenes in parallel
statistics.py   means, spreads, paired differences with their 95 % interval
tables.py       Markdown, CSV, JSON and LaTeX of cells; scores.py names the columns, each with its metric's variant
runs.py         run folders as scenes and methods
Every other module is a protocol of its own: `swimm3r bench NAME --help`.
"""
