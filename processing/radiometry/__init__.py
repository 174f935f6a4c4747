"""From counts to linear signal and radiance, and how bright the next frame shall be."""
