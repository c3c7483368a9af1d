"""What `beliefgym reproduce NAME` computes, one file a result."""
