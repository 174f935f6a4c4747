"""What is to be flown: lines and the specification of a project, and what must be flown again."""
