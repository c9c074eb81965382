//! A line to a board: bytes in both directions, and no wait without an end.

use model_compiler::error::{Error, ErrorCode, Result};
use std::io::{self, ErrorKind, Read, Write};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, PoisonError, RwLock};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

/// How often a wait looks whether there is progress.
const GLANCE: Duration = Duration::from_millis(50);
/// Bytes that are read at once.
const CHUNK: usize = 4096;

/// The host's end of a line. Both directions have a thread, so that neither board nor host can block the other.
#[derive(Debug)]
pub struct Line {
    name: String,
    to_board: Option<Sender<Vec<u8>>>,
    from_board: Receiver<Vec<u8>>,
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

/// What the threads tell.
#[derive(Debug, Default)]
struct Shared {
    /// Bytes that the system took.
    written: AtomicU64,
    is_closing: AtomicBool,
    /// The first failure.
    failure: RwLock<Option<String>>,
}

impl Shared {
    /// Whether a thread goes on after an error: timeouts of the system are only a look around.
    fn survives(&self, error: &io::Error) -> bool {
        let passes = matches!(error.kind(), ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted);
        if !passes {
            let mut failure = self.failure.write().unwrap_or_else(PoisonError::into_inner);
            failure.get_or_insert_with(|| error.to_string());
        }
        passes && !self.is_closing.load(Ordering::Relaxed)
    }

    fn failure(&self) -> Option<String> {
        self.failure.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Line {
    /// A line over two streams. Reads that return from time to time (by a timeout of the stream) let it close in time.
    pub fn new(
        name: impl Into<String>,
        reader: impl Read + Send + 'static,
        writer: impl Write + Send + 'static,
    ) -> Self {
        let shared = Arc::new(Shared::default());
        let (to_board, outgoing) = mpsc::channel();
        let (incoming, from_board) = mpsc::channel();
        let [for_reader, for_writer] = [(); 2].map(|()| Arc::clone(&shared));
        let threads = vec![
            thread::spawn(move || read_all(reader, &incoming, &for_reader)),
            thread::spawn(move || write_all(writer, &outgoing, &for_writer)),
        ];
        Self { name: name.into(), to_board: Some(to_board), from_board, shared, threads }
    }

    /// Name for messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Hands bytes to the writer. What became of them, [`Self::receive`] tells.
    pub fn send(&self, bytes: &[u8]) {
        if let Some(to_board) = &self.to_board {
            // A writer that ended left its reason.
            let _ = to_board.send(bytes.to_vec());
        }
    }

    /// The next bytes from the board; `None` where for so long nothing went either way.
    ///
    /// # Errors
    /// The line is closed or failed.
    pub fn receive(&self, timeout: Duration) -> Result<Option<Vec<u8>>> {
        let (mut since, mut written) = (Instant::now(), self.shared.written.load(Ordering::Relaxed));
        loop {
            match self.from_board.recv_timeout(GLANCE.min(timeout)) {
                Ok(bytes) => return Ok(Some(bytes)),
                Err(RecvTimeoutError::Disconnected) => return Err(self.closed()),
                Err(RecvTimeoutError::Timeout) => {}
            }
            let now = self.shared.written.load(Ordering::Relaxed);
            if now != written {
                (since, written) = (Instant::now(), now);
            }
            if since.elapsed() >= timeout {
                return Ok(None);
            }
        }
    }

    fn closed(&self) -> Error {
        let message =
            self.shared.failure().map_or("the line was closed".into(), |why| format!("the line failed: {why}"));
        Error::new(ErrorCode::Link, &self.name, message).with_help("check power, cable and program of the board")
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        self.shared.is_closing.store(true, Ordering::Relaxed);
        self.to_board = None;
        // A thread that panicked has nothing more to say.
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}

fn read_all(mut reader: impl Read, incoming: &Sender<Vec<u8>>, shared: &Shared) {
    let mut chunk = vec![0; CHUNK];
    loop {
        match reader.read(&mut chunk) {
            Ok(0) => return,
            Ok(count) if incoming.send(chunk[..count].to_vec()).is_err() => return,
            Err(error) if !shared.survives(&error) => return,
            Ok(_) | Err(_) => {}
        }
    }
}

fn write_all(mut writer: impl Write, outgoing: &Receiver<Vec<u8>>, shared: &Shared) {
    for bytes in outgoing {
        let mut rest = bytes.as_slice();
        while !rest.is_empty() {
            match writer.write(rest).and_then(|count| writer.flush().map(|()| count)) {
                Ok(count) => {
                    rest = &rest[count..];
                    shared.written.fetch_add(count as u64, Ordering::Relaxed);
                }
                Err(error) if !shared.survives(&error) => return,
                Err(_) => {}
            }
            if shared.is_closing.load(Ordering::Relaxed) {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOON: Duration = Duration::from_millis(120);

    #[test]
    fn bytes_go_both_ways() {
        let (board_reads, host_writes) = io::pipe().unwrap();
        let (host_reads, board_writes) = io::pipe().unwrap();
        let line = Line::new("board", host_reads, host_writes);
        line.send(b"ping");
        let mut four = [0; 4];
        (&board_reads).read_exact(&mut four).unwrap();
        (&board_writes).write_all(b"pong").unwrap();
        assert_eq!((&four, line.receive(SOON).unwrap().as_deref()), (b"ping", Some(&b"pong"[..])));
        drop(board_writes);
        let error = line.receive(SOON).unwrap_err();
        assert_eq!((error.code.exit_status(), error.message.as_str()), (2, "the line was closed"));
    }

    #[test]
    fn a_silent_board_ends_the_wait() {
        let (_board_reads, host_writes) = io::pipe().unwrap();
        let (host_reads, board_writes) = io::pipe().unwrap();
        let line = Line::new("board", host_reads, host_writes);
        let begin = Instant::now();
        assert_eq!(line.receive(SOON).unwrap(), None);
        assert!(begin.elapsed() >= SOON);
        drop(board_writes);
    }

    #[test]
    fn a_failure_is_told() {
        struct Broken;
        impl Read for Broken {
            fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
                Err(io::Error::other("unplugged"))
            }
        }
        let error = Line::new("board", Broken, io::sink()).receive(SOON).unwrap_err();
        assert_eq!((error.location.as_str(), error.message.as_str()), ("board", "the line failed: unplugged"));
    }
}
