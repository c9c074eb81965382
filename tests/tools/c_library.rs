//! The C interface for the host: whatever of it `firmware` exports is in the static library.
pub use firmware::ffi;
