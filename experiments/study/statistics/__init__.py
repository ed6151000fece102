"""Tables of many runs reduced to what people quote."""
