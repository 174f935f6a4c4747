"""From the frames of one exposure to its images and figures."""
