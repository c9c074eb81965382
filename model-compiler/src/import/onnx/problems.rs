//! The list of what is wrong with a file.

use crate::error::{Error, Result};

/// Problems that are shown one by one.
const SHOWN: usize = 20;

#[derive(Default)]
pub(super) struct Problems {
    first: Vec<Error>,
    count: usize,
}

impl Problems {
    pub(super) fn add(&mut self, error: Error) {
        self.count += 1;
        if self.count <= SHOWN {
            self.first.push(error);
        }
    }

    /// No problem, the only one, or all of them in one error of the first one's class.
    pub(super) fn into_result(mut self) -> Result<()> {
        if self.count < 2 {
            return self.first.pop().map_or(Ok(()), Err);
        }
        let mut message = format!("found {} problems:", self.count);
        let mut helps: Vec<&str> = Vec::new();
        for error in &self.first {
            let separator = if error.location.is_empty() { "" } else { ": " };
            message += &format!("\n  {}{separator}{}", error.location, error.message);
            if !error.help.is_empty() && !helps.contains(&error.help.as_str()) {
                helps.push(&error.help);
            }
        }
        if self.count > SHOWN {
            message += &format!("\n  … and {} more", self.count - SHOWN);
        }
        Err(Error::new(self.first[0].code, "", message).with_help(helps.join("; ")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::ErrorCode;

    #[test]
    fn each_problem_has_its_line_and_each_remedy_stands_once() {
        let mut problems = Problems::default();
        for i in 0..22 {
            problems.add(Error::new(ErrorCode::Malformed, format!("Conv {i}"), "broken").with_help("repair it"));
        }
        let text = problems.into_result().unwrap_err().to_string();
        assert!(text.starts_with("found 22 problems:\n  Conv 0: broken\n  Conv 1: broken\n"), "{text}");
        assert!(text.ends_with("\n  Conv 19: broken\n  … and 2 more\n  help: repair it"), "{text}");
    }
}
