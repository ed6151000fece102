"""What any file or folder of ours holds, told on screen."""
