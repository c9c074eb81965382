//! The feeder's end of the conversation: requests out, answers in, numbered and checked.

use super::line::Line;
use firmware::link::{Damage, MAX_ENCODED, Receiver, Refusal, Request, Response, UpdateRefusal, decode, encode};
use model_compiler::error::{Error, ErrorCode, Result};
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// How long a board that may just be starting is given before it is asked for its name once more.
const RETRY: Duration = Duration::from_secs(2);

/// An answer that arrived whole.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Packet(Vec<u8>);

impl Packet {
    /// What it says.
    pub fn response(&self) -> Response<'_> {
        let (_, response) = decode(&self.0).expect("it was decoded when it arrived");
        response
    }
}

/// A conversation with a board.
#[derive(Debug)]
pub struct Feeder<'l> {
    line: &'l Line,
    timeout: Duration,
    receiver: Receiver,
    arrived: VecDeque<std::result::Result<Vec<u8>, Damage>>,
    /// Number of the next request.
    sequence: u16,
    /// Number of the next answer.
    expected: Option<u16>,
    /// Requests of the exchange under way, for messages.
    sent: VecDeque<(u16, String)>,
    bytes_sent: u64,
}

impl<'l> Feeder<'l> {
    /// A conversation in which nothing is waited for longer than `timeout` after the last byte in either direction.
    pub fn new(line: &'l Line, timeout: Duration) -> Self {
        Self {
            line,
            timeout,
            receiver: Receiver::new(),
            arrived: VecDeque::new(),
            sequence: 0,
            expected: None,
            sent: VecDeque::new(),
            bytes_sent: 0,
        }
    }

    /// Bytes on the line since the last call.
    pub fn take_bytes_sent(&mut self) -> u64 {
        std::mem::take(&mut self.bytes_sent)
    }

    /// Asks who is there, again and again until somebody answers: the board may be starting, and the line in the middle
    /// of something.
    ///
    /// # Errors
    /// Nobody answers, or not in this protocol, or a board without an image.
    pub fn identify(&mut self) -> Result<Packet> {
        self.meet()?.ok_or_else(|| self.refused_last(Refusal::NoImage))
    }

    /// The same, where a board without an image is welcome, too: `None`.
    ///
    /// # Errors
    /// Nobody answers, or not in this protocol.
    pub fn meet(&mut self) -> Result<Option<Packet>> {
        let begin = Instant::now();
        let mut strange = false;
        // Ends whatever the board was receiving.
        self.line.send(&[0]);
        while begin.elapsed() < self.timeout {
            self.send(&Request::Identify, "Identify")?;
            let asked = Instant::now();
            while asked.elapsed() < RETRY.min(self.timeout) {
                // What is left of an earlier conversation is nobody's loss.
                let Some(Ok(bytes)) = self.next_within(RETRY.min(self.timeout))? else { continue };
                let Ok((sequence, response)) = decode::<Response<'_>>(&bytes) else {
                    strange = true;
                    continue;
                };
                match response {
                    Response::Identity(_) => {
                        self.expected = Some(sequence.wrapping_add(1));
                        return Ok(Some(Packet(bytes)));
                    }
                    Response::Refused { reason: Refusal::NoImage, .. } => {
                        self.expected = Some(sequence.wrapping_add(1));
                        return Ok(None);
                    }
                    _ => {}
                }
            }
        }
        if !strange {
            return Err(self.silent());
        }
        let message = "what comes is no answer of this protocol";
        Err(Error::new(ErrorCode::Link, self.line.name(), message)
            .with_help("check the rate of the line (--baud), and that board and host-sim are of one version"))
    }

    /// Sends a request; its number.
    ///
    /// # Errors
    /// It does not fit in a packet.
    pub fn send(&mut self, request: &Request<'_>, what: impl Into<String>) -> Result<u16> {
        let mut buffer = [0; MAX_ENCODED];
        let what = what.into();
        let bytes = encode(self.sequence, request, &mut buffer)
            .map_err(|e| Error::new(ErrorCode::Link, self.line.name(), format!("{what}: {e}")))?;
        self.line.send(bytes);
        self.bytes_sent += bytes.len() as u64;
        self.sent.push_back((self.sequence, what));
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        Ok(sequence)
    }

    /// Sends a request that is answered at once, and waits until it is accepted.
    ///
    /// # Errors
    /// It is refused, or not answered.
    pub fn ask(&mut self, request: &Request<'_>, what: impl Into<String>) -> Result<()> {
        self.try_ask(request, what)?.map_err(|reason| self.refused_last(reason))
    }

    /// The same, where the caller knows what to do about a refusal.
    ///
    /// # Errors
    /// It is not answered.
    pub fn try_ask(
        &mut self,
        request: &Request<'_>,
        what: impl Into<String>,
    ) -> Result<std::result::Result<(), Refusal>> {
        self.begin_exchange();
        let asked = self.send(request, what)?;
        loop {
            match self.receive()?.response() {
                Response::Accepted { request } if request == asked => return Ok(Ok(())),
                Response::Refused { request, reason } if request == asked => return Ok(Err(reason)),
                _ => {}
            }
        }
    }

    /// Whether a request belongs to the exchange under way, and not to one that was given up.
    pub fn is_current(&self, request: u16) -> bool {
        self.sent.iter().any(|(number, _)| *number == request)
    }

    /// Forgets the requests of the exchange before.
    pub fn begin_exchange(&mut self) {
        self.sent.clear();
    }

    /// The next answer.
    ///
    /// # Errors
    /// None comes in time, or one is damaged or lost.
    pub fn receive(&mut self) -> Result<Packet> {
        match self.next_within(self.timeout)? {
            None => Err(self.silent()),
            Some(Err(damage)) => Err(self.damaged(damage)),
            Some(Ok(bytes)) => self.check(bytes),
        }
    }

    /// Why a request was not carried out.
    pub fn refused(&self, request: u16, reason: Refusal) -> Error {
        let what = self.sent.iter().find(|(number, _)| *number == request);
        let what = what.map_or_else(|| format!("request {request}"), |(_, what)| what.clone());
        Error::new(ErrorCode::Link, self.line.name(), format!("the board refuses {what}: {reason}"))
            .with_help(remedy(reason))
    }

    /// Why the last request was not carried out.
    pub fn refused_last(&self, reason: Refusal) -> Error {
        self.refused(self.sequence.wrapping_sub(1), reason)
    }

    fn next_within(&mut self, timeout: Duration) -> Result<Option<std::result::Result<Vec<u8>, Damage>>> {
        while self.arrived.is_empty() {
            let Some(bytes) = self.line.receive(timeout)? else { return Ok(None) };
            for byte in bytes {
                self.arrived.extend(self.receiver.push(byte).map(|packet| packet.map(<[u8]>::to_vec)));
            }
        }
        Ok(self.arrived.pop_front())
    }

    /// A packet that is whole and the next one.
    fn check(&mut self, bytes: Vec<u8>) -> Result<Packet> {
        let decoded = decode::<Response<'_>>(&bytes).map(|(sequence, _)| sequence);
        let sequence = decoded.map_err(|damage| self.damaged(damage))?;
        let expected = self.expected.replace(sequence.wrapping_add(1)).unwrap_or(sequence);
        match sequence.wrapping_sub(expected) {
            0 => Ok(Packet(bytes)),
            lost => {
                Err(self.faulty(&format!("answers were lost on the line: packet {sequence} came {lost} too early")))
            }
        }
    }

    fn damaged(&self, damage: Damage) -> Error {
        self.faulty(&format!("an answer is damaged: {damage}"))
    }

    /// Something about the line that should not be.
    pub fn faulty(&self, message: &str) -> Error {
        Error::new(ErrorCode::Link, self.line.name(), message)
            .with_help("check that both ends use the same rate, or lower it; look at cable and ground")
    }

    fn silent(&self) -> Error {
        let last = self.sent.back().map_or_else(String::new, |(_, what)| format!(" after {what}"));
        let message = format!("the board is silent: nothing came for {:?}{last}", self.timeout);
        Error::new(ErrorCode::Link, self.line.name(), message)
            .with_help("is its program the one that answers requests? A slow board needs a longer --timeout SECONDS")
    }
}

fn remedy(reason: Refusal) -> &'static str {
    match reason {
        Refusal::Untested => "leave --no-self-test out",
        Refusal::SelfTestFailed { .. } => "the image in the board's memory is damaged, or its kernels are wrong",
        Refusal::Configuration => "the camera's image must not be smaller than the network's crop",
        Refusal::NoSuchSensor | Refusal::InputsMissing => {
            "--crop sends the network's inputs in place of the sensors' data"
        }
        Refusal::NoDriver => "only a driving network follows a log; --frames and --inputs run any network",
        Refusal::NoImage => {
            "flash an image that is compiled for this board's target; firmware/boards/README.md says which"
        }
        Refusal::Update(UpdateRefusal::ForeignTarget { .. }) => "compile it with --target of the board",
        Refusal::Update(UpdateRefusal::Older { .. }) => "compile it with a higher --revision",
        Refusal::Update(UpdateRefusal::Running) => "there is nothing to do",
        Refusal::Update(UpdateRefusal::Arena { .. }) => "compile it with --ram of what there is",
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io;

    const SOON: Duration = Duration::from_millis(100);

    fn answers(packets: &[(u16, Response<'_>)], change: impl Fn(&mut Vec<u8>)) -> Vec<u8> {
        let mut buffer = [0; MAX_ENCODED];
        let mut stream = packets.iter().flat_map(|(n, r)| encode(*n, r, &mut buffer).unwrap().to_vec()).collect();
        change(&mut stream);
        stream
    }

    /// What a conversation makes of these answers to one request.
    fn asked(packets: &[(u16, Response<'_>)], change: impl Fn(&mut Vec<u8>)) -> Result<()> {
        let (quiet, keep) = io::pipe().unwrap();
        let line = Line::new("board", io::Read::chain(io::Cursor::new(answers(packets, change)), quiet), io::sink());
        let result = Feeder::new(&line, SOON).ask(&Request::SelfTest, "SelfTest");
        drop(keep);
        result
    }

    #[test]
    fn answers_are_told_apart_by_the_number_of_their_request() {
        let accepted = |request| Response::Accepted { request };
        assert_eq!(asked(&[(4, accepted(9)), (5, accepted(0))], |_| ()), Ok(()));
        let reason = Refusal::SelfTestFailed { step: Some(3) };
        let error = asked(&[(0, Response::Refused { request: 0, reason })], |_| ()).unwrap_err();
        assert_eq!(error.message, "the board refuses SelfTest: step 3 does not give the known answer");
        assert_eq!(error.code.exit_status(), 2);
    }

    #[test]
    fn silence_damage_and_loss_are_told_apart() {
        let accepted = |request| Response::Accepted { request };
        let message = |packets: &[_], change: fn(&mut Vec<u8>)| asked(packets, change).unwrap_err().message;
        assert_eq!(message(&[], |_| ()), "the board is silent: nothing came for 100ms after SelfTest");
        let wrong = message(&[(0, accepted(0))], |stream| stream[1] ^= 3);
        assert_eq!(wrong, "an answer is damaged: packet with a wrong CRC");
        let lost = message(&[(0, accepted(7)), (3, accepted(0))], |_| ());
        assert_eq!(lost, "answers were lost on the line: packet 3 came 2 too early");
    }
}
