//! Runs the firmware's engine on the host.
#![forbid(unsafe_code)]
