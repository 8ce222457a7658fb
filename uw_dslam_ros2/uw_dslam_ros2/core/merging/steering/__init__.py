"""What people, fixes and known starts say of a merge."""
