"""The embedded talking-head corpus."""
