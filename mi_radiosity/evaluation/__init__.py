"""Judging solutions: path-traced references, metrics, comparisons, benchmarks."""
