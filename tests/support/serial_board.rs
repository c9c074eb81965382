//! The driving computer behind a pseudo-terminal: a board for `host-sim hil --port`, in a thread of the test.

use firmware::actuators::{Actuate, ActuatorFault, Duties};
use firmware::computer::{self, Computer, Line, Memory, NoStore};
use firmware::drive::Output;
use firmware::image::Image;
use firmware::kernels::Portable;
use firmware::link::{MAX_ENCODED, Request, encode};
use host_sim::buffers::GuardedArena;
use model_compiler::emit::AlignedBytes;
use serialport::{SerialPort, TTYPort};
use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// How long the board sleeps where there is nothing to do.
const NAP: Duration = Duration::from_micros(200);
/// How long it waits for the line to take its answer.
const PATIENCE: Duration = Duration::from_secs(20);

/// What becomes of a packet on its way: its bytes, the zero at the end included, by number from 0 on.
pub type Accident = Box<dyn FnMut(usize, Vec<u8>) -> Vec<u8> + Send>;

/// A line on which nothing happens.
pub fn faultless() -> Accident {
    Box::new(|_, packet| packet)
}

/// A board that serves until it is dropped.
pub struct SerialBoard {
    device: String,
    /// Keeps the line up between two feeders.
    _slave: File,
    is_ending: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl SerialBoard {
    /// A board with this image in its memory. `requests` and `answers`: what the line does to packets.
    ///
    /// # Panics
    /// The system has no pseudo-terminals.
    pub fn start(image: &[u8], requests: Accident, answers: Accident) -> Self {
        let (mut master, slave) = TTYPort::pair().expect("a pseudo-terminal");
        master.set_timeout(Duration::ZERO).expect("a timeout");
        let device = slave.name().expect("its name");
        let is_ending = Arc::new(AtomicBool::new(false));
        let (image, ending) = (image.to_vec(), Arc::clone(&is_ending));
        // Opened before the other handle goes: a terminal without any forgets its modes.
        let kept = File::options().read(true).write(true).open(&device).expect("the terminal's other end");
        let thread = thread::spawn(move || {
            let image = AlignedBytes::from(image.as_slice());
            let mut arena = Image::parse(&image).ok().map(|image| GuardedArena::new(&image));
            let mut board = Board {
                master,
                requests: Wire::new(requests),
                answers: Wire::new(answers),
                start: Instant::now(),
                is_ending: ending,
                has_ended: false,
            };
            let computer = Computer {
                image: &image,
                kernels: Portable,
                arena: arena.as_mut().map_or_else(|| (&mut [][..]).into(), |arena| arena.poisoned(0)),
                memory: &mut Memory::new(),
                line: &mut Line::new(),
                board: &mut board,
                actuators: &mut Outputs,
                store: &mut NoStore,
            };
            computer.run();
        });
        Self { device, _slave: kept, is_ending, thread: Some(thread) }
    }

    /// A board on a faultless line.
    pub fn with(image: &[u8]) -> Self {
        Self::start(image, faultless(), faultless())
    }

    /// Name of the serial device.
    pub fn device(&self) -> &str {
        &self.device
    }
}

impl Drop for SerialBoard {
    fn drop(&mut self) {
        self.is_ending.store(true, Ordering::Relaxed);
        let ended = self.thread.take().is_none_or(|thread| thread.join().is_ok());
        assert!(ended || thread::panicking(), "the board panicked");
    }
}

/// One direction of the line.
struct Wire {
    accident: Accident,
    packet: Vec<u8>,
    packets: usize,
    arrived: VecDeque<u8>,
}

impl Wire {
    fn new(accident: Accident) -> Self {
        Self { accident, packet: Vec::new(), packets: 0, arrived: VecDeque::new() }
    }

    fn push(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.packet.push(byte);
            if byte == 0 && self.packet.len() > 1 {
                self.arrived.extend((self.accident)(self.packets, std::mem::take(&mut self.packet)));
                self.packets += 1;
            }
        }
    }
}

struct Board {
    master: TTYPort,
    requests: Wire,
    answers: Wire,
    start: Instant,
    is_ending: Arc<AtomicBool>,
    has_ended: bool,
}

impl computer::Board for Board {
    fn name(&self) -> &str {
        "test board"
    }

    fn receive(&mut self) -> Option<u8> {
        if self.requests.arrived.is_empty() {
            let mut chunk = [0; 4096];
            match self.master.read(&mut chunk) {
                Ok(count) => self.requests.push(&chunk[..count]),
                Err(_) if self.is_ending.load(Ordering::Relaxed) && !self.has_ended => {
                    self.has_ended = true;
                    let mut buffer = [0; MAX_ENCODED];
                    for (sequence, request) in [(0, Request::Identify), (1, Request::Halt)] {
                        let packet = encode(sequence, &request, &mut buffer).expect("a short message");
                        self.requests.arrived.push_back(0);
                        self.requests.arrived.extend(&*packet);
                    }
                }
                Err(_) => {}
            }
        }
        self.requests.arrived.pop_front()
    }

    fn send(&mut self, bytes: &[u8]) {
        self.answers.push(bytes);
        let bytes: Vec<u8> = self.answers.arrived.drain(..).collect();
        let (mut rest, begin) = (bytes.as_slice(), Instant::now());
        while !rest.is_empty() && !self.is_ending.load(Ordering::Relaxed) {
            match self.master.write(rest) {
                Ok(count) => rest = &rest[count..],
                Err(error) if error.kind() == io::ErrorKind::TimedOut && begin.elapsed() < PATIENCE => {
                    thread::sleep(NAP)
                }
                Err(error) => panic!("the line failed: {error}"),
            }
        }
    }

    fn ticks(&mut self) -> u64 {
        self.start.elapsed().as_micros() as u64
    }

    fn hertz(&self) -> u64 {
        1_000_000
    }

    fn feed_watchdog(&mut self) {}

    fn wait(&mut self) {
        thread::sleep(NAP);
    }

    fn can_halt(&self) -> bool {
        self.has_ended
    }
}

struct Outputs;

impl Actuate for Outputs {
    fn apply(&mut self, _: &Output) -> Result<Duties, ActuatorFault> {
        Ok(Duties::default())
    }
}
