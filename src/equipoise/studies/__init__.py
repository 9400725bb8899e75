"""What one asks of the results, and of the program itself."""
