"""The onboard service: when to expose, what is stored, who may watch and ask."""
