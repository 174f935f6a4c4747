"""Bundle adjustment: one engine for laboratory, platform and block.

`network` says what is measured and known, `adjust` adjusts it, `rank` names what it cannot
determine, `self_calibration` offers sets of additional parameters, `start` gives starting values.
No file is opened here.
"""
