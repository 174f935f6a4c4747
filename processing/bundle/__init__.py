"""Bundle adjustment: one engine for laboratory, platform and block.

`network` holds observations and prior knowledge, `adjust` adjusts them, `rank_diagnosis` names
undetermined parameters, `self_calibration` provides sets of additional parameters,
`initial_values` computes starting values.
No file is opened here.
"""
