"""What a Crazyflie sends over its radio link: log variables, sampled."""
