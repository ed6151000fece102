"""Tables and summaries in; screens, figures, reports and files out. Decides nothing."""
