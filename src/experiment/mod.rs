//! The experiment language: YAML layers become a typed, checked, planned graph of stages.
