//! integer_reference
