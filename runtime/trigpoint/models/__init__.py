"""Networks: what is asked of them, and what is made of their outputs."""
