"""Of a sonar that turns: turns laid on one another, and what they tell."""
