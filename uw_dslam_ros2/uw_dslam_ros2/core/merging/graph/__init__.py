"""What is known: submaps, odometry, answers, and which of them are joined."""
