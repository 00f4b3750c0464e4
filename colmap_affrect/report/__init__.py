"""Pictures and tables that show what the other layers did."""
