"""Where sensors and cameras sit on their arms, and how late their pictures arrive."""
