"""Tables, figures and files made of finished runs."""
