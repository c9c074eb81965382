//! The board's end of the line: what was received, what is sent, and what got lost.

use super::{Board, log};
use crate::link::{LinkCounters, MAX_ENCODED, Receiver, Refusal, Response, encode};
use heapless::Deque;

/// Bytes that may come in while a step of the network runs.
const WAITING_BYTES: usize = 2048;

/// The board's end of the line. Outlives the drives on it.
#[derive(Debug, Default)]
pub struct Line {
    pub(super) receiver: Receiver,
    pub(super) sender: Sender,
}

impl Line {
    /// A line before its first byte.
    pub const fn new() -> Self {
        Self { receiver: Receiver::new(), sender: Sender::new() }
    }
}

/// All of the line but the packet under way.
#[derive(Debug)]
pub(super) struct Sender {
    waiting: Deque<u8, WAITING_BYTES>,
    buffer: [u8; MAX_ENCODED],
    next_sent: u16,
    next_received: Option<u16>,
    pub counters: LinkCounters,
}

/// What the number of a packet says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Order {
    /// It follows the packet before.
    Next,
    /// Packets between are missing.
    AfterLoss,
    /// It was there before.
    Repeated,
}

impl Default for Sender {
    fn default() -> Self {
        Self::new()
    }
}

impl Sender {
    const fn new() -> Self {
        let counters = LinkCounters {
            packets: 0,
            damaged: 0,
            lost: 0,
            repeated: 0,
            overflowed: 0,
            incomplete_frames: 0,
            abandoned_frames: 0,
        };
        Self { waiting: Deque::new(), buffer: [0; MAX_ENCODED], next_sent: 0, next_received: None, counters }
    }

    /// The next received byte.
    pub fn next_byte<B: Board>(&mut self, board: &mut B) -> Option<u8> {
        self.waiting.pop_front().or_else(|| board.receive())
    }

    /// Takes in what came while something else was done.
    pub fn take_in<B: Board>(&mut self, board: &mut B) {
        while let Some(byte) = board.receive() {
            if self.waiting.push_back(byte).is_err() {
                self.counters.overflowed = self.counters.overflowed.saturating_add(1);
            }
        }
    }

    /// Sends a message.
    pub fn send<B: Board>(&mut self, board: &mut B, message: &Response<'_>) {
        // All messages of a board fit in a packet (see the tests of `link`); one that did not would be left out.
        if let Ok(bytes) = encode(self.next_sent, message, &mut self.buffer) {
            self.next_sent = self.next_sent.wrapping_add(1);
            board.send(bytes);
        }
    }

    /// Answers a request.
    pub fn answer<B: Board>(&mut self, board: &mut B, request: u16, outcome: Result<(), Refusal>) {
        let message = match outcome {
            Ok(()) => Response::Accepted { request },
            Err(reason) => {
                log::refused(request, reason);
                Response::Refused { request, reason }
            }
        };
        self.send(board, &message);
    }

    pub fn count_damaged(&mut self) {
        self.counters.damaged = self.counters.damaged.saturating_add(1);
    }

    /// Takes note of a packet that arrived whole. A conversation begins with any number.
    pub fn note(&mut self, sequence: u16, begins: bool) -> Order {
        self.counters.packets = self.counters.packets.saturating_add(1);
        let expected = self.next_received.filter(|_| !begins).unwrap_or(sequence);
        let gap = sequence.wrapping_sub(expected);
        // Half the numbers lie ahead, half behind.
        if gap.cast_signed() < 0 {
            self.counters.repeated = self.counters.repeated.saturating_add(1);
            return Order::Repeated;
        }
        self.counters.lost = self.counters.lost.saturating_add(gap.into());
        self.next_received = Some(sequence.wrapping_add(1));
        if gap == 0 { Order::Next } else { Order::AfterLoss }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_tell_of_losses_and_repetitions() {
        let mut sender = Sender::new();
        for (sequence, begins, order, lost) in [
            (65534, false, Order::Next, 0),
            (65535, false, Order::Next, 0),
            (0, false, Order::Next, 0),
            (3, false, Order::AfterLoss, 2),
            (3, false, Order::Repeated, 2),
            (1, false, Order::Repeated, 2),
            (4, false, Order::Next, 2),
            (100, true, Order::Next, 2),
            (101, false, Order::Next, 2),
        ] {
            assert_eq!((sender.note(sequence, begins), sender.counters.lost), (order, lost), "packet {sequence}");
        }
        assert_eq!((sender.counters.packets, sender.counters.repeated), (9, 2));
    }
}
