"""What came of a run, for people: reports, pictures, scores, walls as lines."""
