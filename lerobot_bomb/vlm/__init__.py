"""Vision-language backbones: from the Hub, from a folder, or small ones built in code."""
