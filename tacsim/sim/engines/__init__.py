"""Bodies moved by other engines, with the gels of tacsim between them. Only this room imports MuJoCo."""
