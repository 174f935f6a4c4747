"""Where images looked from and what they saw: orientation, footprints, triangulation."""
