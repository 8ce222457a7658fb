"""What is kept of a recording: navigation, some of its pings, what their pixels hold."""
