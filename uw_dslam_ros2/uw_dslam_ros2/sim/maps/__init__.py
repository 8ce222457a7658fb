"""Maps and point sets with known answers, without a sonar: for tests, studies and benchmarks."""
