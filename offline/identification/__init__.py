"""Identification: from pressure and angle as they were measured to parameters with honest intervals.

`series` holds measurements, `structure` says which terms a model has, `regression` is the paper's filtered least squares and
the instrumental variables, `output_error` fits a free simulation, `intervals` says how sure the values are.
"""
