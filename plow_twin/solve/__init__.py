"""How the motion is advanced: series, events, the loop; fixed-step methods."""
