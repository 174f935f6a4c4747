"""What a mission holds against its chain of hashes, and recovery after a crash."""
