//! How far long work is: one bar on standard error, drawn only where that is a terminal.

use indicatif::{HumanDuration, ProgressBar, ProgressState, ProgressStyle};
use std::fmt::Write;
use std::time::Duration;

const TICK: Duration = Duration::from_millis(200);

/// The bar of both command lines: what is done, how much of it, for how long, and how long it will take.
pub fn progress_bar() -> ProgressBar {
    let style = ProgressStyle::with_template("{msg} [{wide_bar}] {percent:>3} %  {elapsed}{left}");
    let style = style.expect("the template is valid").progress_chars("=> ").with_key("left", left);
    let bar = ProgressBar::new(1).with_style(style).with_message("load");
    bar.enable_steady_tick(TICK);
    bar
}

/// Nothing before the first unit is done: nothing is known then.
fn left(state: &ProgressState, text: &mut dyn Write) {
    if state.pos() > 0 {
        let _ = write!(text, ", {:#} left", HumanDuration(state.eta()));
    }
}

/// The bar of a program that may have nothing to show.
#[derive(Default)]
pub(super) struct Bar(Option<ProgressBar>);

impl Bar {
    pub(super) fn show(&mut self, stage: &str, done: usize, total: usize) {
        let bar = self.0.get_or_insert_with(progress_bar);
        bar.set_message(stage.to_owned());
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    }

    pub(super) fn finish(&self) {
        self.0.iter().for_each(ProgressBar::finish_and_clear);
    }
}
