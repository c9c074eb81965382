//! What a classifier says, frame by frame: those first where integers and f32 do not agree.

use super::table;
use crate::classification::{ClassificationSummary, ClassifiedFrame};
use crate::report::FrameReport;
use crate::report::figures::decibels;
use maud::{Markup, html};

/// Frames in the table.
const SHOWN: usize = 200;

pub(super) fn section(summary: Option<&ClassificationSummary>, frames: &[FrameReport]) -> Markup {
    let Some(summary) = summary else { return html! {} };
    let mut seen: Vec<(&str, &ClassifiedFrame)> =
        frames.iter().filter_map(|frame| Some((frame.name.as_str(), frame.classes.as_ref()?))).collect();
    let rank = |frame: &ClassifiedFrame| {
        let agrees = frame.reference_top1.is_none_or(|class| class == frame.int8.top1);
        (agrees, frame.int8.is_right().unwrap_or(true))
    };
    seen.sort_by_key(|(_, frame)| rank(frame));
    let row = |(name, frame): &(&str, &ClassifiedFrame)| {
        let class = |class: Option<usize>| class.map_or("–".to_owned(), |class| class.to_string());
        let (agrees, _) = rank(frame);
        vec![
            (*name).to_owned(),
            if agrees { "yes" } else { "NO" }.to_owned(),
            class(Some(frame.int8.top1)),
            class(frame.reference_top1),
            class(frame.int8.label),
        ]
    };
    let rows: Vec<_> = seen.iter().take(SHOWN).map(row).collect();
    let about = html! {
        "The class with the largest logit. Frames on which integers and f32 differ come first, then those on which the "
        "class is not the label."
        @if seen.len() > SHOWN { " Shown are " (SHOWN) " of " (seen.len()) " frames." }
    };
    let content = html! {
        dl.figures { @for (name, value) in figures(summary) { div { dt { (name) } dd { (value) } } } }
        (table(&["frame", "same class", "integers", "f32", "label"], 2, &rows))
    };
    super::section("classes", "Classes", &about, &content)
}

fn figures(summary: &ClassificationSummary) -> Vec<(&'static str, String)> {
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    let shares = [
        ("Same class in integers and f32", summary.agreement.as_ref().map(|agreement| agreement.share)),
        ("Right, integers", summary.int8.as_ref().map(|accuracy| accuracy.top1)),
        ("Right, f32", summary.float.as_ref().map(|accuracy| accuracy.top1)),
    ];
    let logits = summary.logits_sqnr_db.map(|db| ("Logits", decibels(Some(db))));
    shares.into_iter().filter_map(|(name, share)| Some((name, percent(share?)))).chain(logits).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::classification::Comparison;
    use crate::report::tests::report;
    use model_compiler::frames::{Frame, Label};

    #[test]
    fn frames_that_differ_come_first() {
        let mut comparison = Comparison::default();
        let mut frames = Vec::new();
        for (name, int8, float) in [("same", [0.0_f32, 1.0], [0.0_f32, 2.0]), ("differs", [3.0, 1.0], [0.0, 2.0])] {
            let label = Some(Label { class: 1, name: String::new() });
            let frame = Frame { name: name.into(), label, ..Frame::default() };
            let classes = comparison.add(&frame, &int8, Some(&float));
            frames.push(FrameReport { name: name.into(), classes: Some(classes), ..report().frames[0].clone() });
        }
        let page = section(comparison.summary().as_ref(), &frames).into_string();
        assert!(page.find(">differs<").unwrap() < page.find(">same<").unwrap(), "{page}");
        assert!(page.contains("50.00 %") && page.contains("100.00 %"), "{page}");
        assert!(section(None, &frames).into_string().is_empty());
    }
}
