"""SBG Systems inertial units: sbgECom logs into records, and the device on a line."""
