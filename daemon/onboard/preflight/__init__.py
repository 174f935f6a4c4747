"""What is checked before a flight, and how a mission is resumed."""
