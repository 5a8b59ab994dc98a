"""The benchmark: reconstruct every image that has a known surface, measure, report. It asserts nothing.

`run` works off images, `figures` names the numbers and what is wanted of them, `report` writes tables and compares two
runs. Use: ``python -m sftex_stages.bench --help`` or ``make bench``.
"""
