"""What we are measured by, side by side with peers in the same run."""
