//! Messages between a board and whoever feeds it, over any serial line.
//!
//! A *packet* is a message with a sequence number, written by postcard, followed by its CRC-32 (little-endian), made
//! free of zeros by COBS and ended by a zero. Whoever listens in the middle of a stream is in step at the next zero; a
//! damaged packet costs itself and nothing else, and the gap in the sequence numbers tells that it is missing.
//!
//! # Conversation
//!
//! The feeder sends [`Request`]s, the board answers each with a [`Response`], except the pieces of a frame ([`Row`],
//! [`Points`], [`Input`] and the [`Begin`] before them): these flow without waiting, and the frame's
//! [`End`](Request::End) is answered for all by the [`Telemetry`]. Numbers of the sequence count up by one per packet
//! and direction, and wrap.
//!
//! ```text
//! feeder                                   board
//! Identify                            ──►  Identity (board, image, digests, clock)
//! Configure (camera, mounting, limits) ─►  Accepted
//! Route (node) …                      ──►  Accepted …
//! SelfTest                            ──►  Accepted (the known answer, every step)
//! Begin, Row…, Points…, End           ──►  Step… and Output… where asked for, Telemetry
//! Announce, Piece…, Install           ──►  Accepted, … (a new image, see crate::update)
//! Restart                             ──►  Accepted; Identify again
//! ```
//!
//! # What the line must carry
//!
//! The line's rate decides how many frames per second are possible, long before the network does. A byte on an
//! asynchronous line is ten bits; packets add about 2 %:
//!
//! | per frame | bytes | 115,200 baud | 1 Mbaud | 12 Mbit/s (USB) |
//! |---|---|---|---|---|
//! | raw image, 400×300 RGB | 360,000 | 31.3 s | 3.6 s | 0.30 s |
//! | its rows that the crop of 256×256 needs | 307,200 | 26.7 s | 3.1 s | 0.26 s |
//! | the crop itself ([`Input`]) | 196,608 | 17.1 s | 2.0 s | 0.16 s |
//! | 20,000 LiDAR points, 12 bytes each | 240,000 | 20.8 s | 2.4 s | 0.20 s |
//! | the bird's-eye view itself ([`Input`]) | 131,072 | 11.4 s | 1.3 s | 0.11 s |
//! | everything else | about 60 | 5 ms | 0.6 ms | 0.1 ms |
//!
//! A vehicle that is driven 20 times a second therefore has its camera on a parallel or MIPI interface and its LiDAR on
//! Ethernet, and calls [`crate::sensors`] directly; the serial link is for the bench, for logs, and for updates.
//!
//! [`Row`]: Request::Row
//! [`Points`]: Request::Points
//! [`Input`]: Request::Input
//! [`Begin`]: Request::Begin
//! [`Telemetry`]: Response::Telemetry

#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

mod packet;
mod request;
mod response;

pub use packet::{Damage, MAX_ENCODED, MAX_PACKET, Receiver, TooLong, decode, encode};
pub use request::{CameraSetup, Configuration, Detail, End, Request};
pub use response::{Answer, Identity, LinkCounters, Refusal, Response, StepReport, Telemetry, UpdateRefusal};

/// Version of the messages; boards and feeders of different versions do not talk.
pub const PROTOCOL: u16 = 1;

/// Most bytes of pixels, points or tensor in one message.
pub const MAX_PIECE: usize = 960;
