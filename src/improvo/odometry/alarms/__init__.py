"""What ends a map, keeps something out of it, or makes it doubtful while it runs; one file for each cause."""
