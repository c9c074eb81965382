//! The programs that run on a board.

pub mod self_test;
