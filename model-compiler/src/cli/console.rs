//! Where a command writes.

use std::io::Write;

/// Where a command line writes: results to `out`, everything else to `err`.
pub struct Console<'a> {
    /// Standard output.
    pub out: &'a mut dyn Write,
    /// Standard error.
    pub err: &'a mut dyn Write,
}

/// A closed pipe is the reader's choice and no error.
impl Console<'_> {
    /// Writes a result, ended by one line end.
    pub fn print(&mut self, text: &str) {
        let _ = writeln!(self.out, "{}", text.trim_end());
    }

    /// Writes a warning, an error or usage.
    pub fn complain(&mut self, text: &str) {
        let _ = writeln!(self.err, "{}", text.trim_end());
    }
}
