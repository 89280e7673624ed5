"""What any program needs and nothing of robots: whole files, parallel work, user code, extras that may be missing."""
