"""GenICam descriptions of real cameras, evaluated as the GenApi standard defines them.

A reading of its own, independent of Aravis: parsing is in `description_file`, formulas in
`formula`, values, limits and access modes in `node_map`, registers after power-on in
`power_on_state`.
"""
