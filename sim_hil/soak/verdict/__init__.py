"""What a soak has measured, and whether it stays within its budget."""
