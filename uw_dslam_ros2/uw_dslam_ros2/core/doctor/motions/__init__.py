"""How the sonar moved by its echoes, and how well navigation fits to it."""
