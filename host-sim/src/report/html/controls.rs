//! What a network that gives controls says, frame by frame, beside the f32 network: the worst frame first.

use super::table;
use crate::report::FrameReport;
use crate::report::controls::{DIGITS, titled};
use crate::report::figures::figure;
use maud::{Markup, html};

/// Frames in the table.
const SHOWN: usize = 200;

pub(super) fn section(frames: &[FrameReport]) -> Markup {
    let mut given: Vec<&FrameReport> = frames.iter().filter(|frame| frame.control.is_some()).collect();
    let Some(names) = given.first().and_then(|frame| frame.control.as_ref()) else { return html! {} };
    let names: Vec<String> = names.values().map(|(name, _)| titled(name)).collect();
    given.sort_by(|a, b| b.badness().total_cmp(&a.badness()));
    let row = |frame: &&FrameReport| {
        let both = [("integers", &frame.control), ("f32", &frame.reference_control)];
        let line = |(network, prediction): (&str, &Option<_>)| {
            let prediction: &crate::controls::ControlPrediction = prediction.as_ref()?;
            let values = prediction.values().map(|(_, value)| figure(Some(value), DIGITS));
            Some([frame.name.clone(), network.to_owned()].into_iter().chain(values).collect())
        };
        both.into_iter().filter_map(line).collect::<Vec<Vec<String>>>()
    };
    let rows: Vec<_> = given.iter().take(SHOWN).flat_map(row).collect();
    let about = html! {
        "Steer, throttle and brake as the networks give them, before the agent's post-processing; frames with the "
        "largest error first."
        @if given.len() > SHOWN { " Shown are " (SHOWN) " of " (given.len()) " frames." }
    };
    let header: Vec<&str> = ["frame", "network"].into_iter().chain(names.iter().map(String::as_str)).collect();
    super::section("controls", "Controls", &about, &table(&header, 2, &rows))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::controls::tests::prediction;
    use crate::report::tests::report;

    #[test]
    fn both_networks_stand_below_each_other_worst_frame_first() {
        let frame = |name: &str, steer| FrameReport {
            name: name.into(),
            control: Some(prediction(steer)),
            reference_control: Some(prediction(0.25)),
            waypoint_error_mm: vec![],
            ..report().frames[0].clone()
        };
        let page = section(&[frame("good", 0.25), frame("bad", 0.5)]).into_string();
        let at = |text: &str| page.find(text).unwrap_or_else(|| panic!("{text} in {page}"));
        assert!(at(">bad<") < at("0.5000") && at("0.5000") < at(">good<"));
        assert!(page.contains("speed, m/s") && page.matches(">f32<").count() == 2, "{page}");
        assert_eq!(section(&report().frames).into_string(), "");
    }
}
