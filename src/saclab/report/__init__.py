"""From run folders to verdicts: which runs compare, statistics, figures, tables, a page."""
