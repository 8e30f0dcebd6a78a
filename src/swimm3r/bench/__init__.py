"""The paper's protocols as commands, over finished run folders."""
