"""What everything stands on: components as pytrees, checks of input, small linear algebra, status flags, files made in one piece."""
