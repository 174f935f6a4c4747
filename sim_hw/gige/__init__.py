"""Emulated GigE Vision heads: GVCP control, GVSP streaming and the GenICam description.

Written from the GigE Vision 2.0 and SFNC documents; `gige_head` combines the parts.
"""
