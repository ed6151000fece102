"""What a file or folder of ours holds."""
