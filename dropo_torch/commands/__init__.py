"""The command line: what each verb reads, writes and shows."""
