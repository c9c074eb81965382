//! `inspect --diff`: what changed between two images. Exit status 0 where they are equal, 1 where not.

use super::inspect::table;
use crate::emit::AlignedBytes;
use crate::error::{Error, ErrorCode, Result};
use crate::image_diff::{Change, ImageDiff, StepChange, diff};
use firmware::image::Image;
use std::fmt::Write as _;
use std::path::Path;

/// The difference as text or JSON, and the exit status.
///
/// # Errors
/// A file that cannot be read or is no image.
pub(super) fn run(before: &Path, after: &Path, json: bool) -> Result<(String, u8)> {
    let read = |path: &Path| -> Result<AlignedBytes> {
        Ok(AlignedBytes::from(std::fs::read(path).map_err(|e| Error::io(path, &e))?.as_slice()))
    };
    let (before_bytes, after_bytes) = (read(before)?, read(after)?);
    let parse = |bytes, path: &Path| -> Result<Image<'_>> {
        let image = Image::parse(bytes).map_err(|e| Error::from(e).within(path.display()))?;
        image.check().map_err(|e| Error::from(e).within(path.display()))?;
        Ok(image)
    };
    let found = diff(&parse(&before_bytes, before)?, &parse(&after_bytes, after)?)?;
    let text = if json {
        serde_json::to_string_pretty(&found).map_err(|e| Error::new(ErrorCode::Malformed, "", e.to_string()))?
    } else {
        shown(&found)
    };
    Ok((text, u8::from(!found.equal)))
}

fn shown(diff: &ImageDiff) -> String {
    if diff.equal {
        return "the images are equal".into();
    }
    let mut text = String::new();
    for (title, changes) in [("header", &diff.header), ("port", &diff.ports)] {
        if !changes.is_empty() {
            let mut rows = table(&[title, "before", "after"], 3);
            changes.iter().for_each(|change| {
                rows.add_row(row(change));
            });
            let _ = writeln!(text, "{}\n", rows.trim_fmt());
        }
    }
    if !diff.sections.is_empty() {
        let mut rows = table(&["section", "crc32 before", "after", "bytes before", "after"], 3);
        for section in &diff.sections {
            let (before, after) = (section.before_bytes.to_string(), section.after_bytes.to_string());
            rows.add_row([section.section, &section.before_crc, &section.after_crc, &before, &after]);
        }
        let _ = writeln!(text, "{}\n", rows.trim_fmt());
    }
    if !diff.steps.is_empty() {
        let mut rows = table(&["step", "op", "what", "before", "after"], 5);
        diff.steps.iter().flat_map(step_rows).for_each(|cells| {
            rows.add_row(cells);
        });
        let _ = writeln!(text, "{}\n", rows.trim_fmt());
    }
    let count = |of: fn(&StepChange) -> bool| diff.steps.iter().filter(|step| of(step)).count();
    let (added, removed) = (count(|step| step.before.is_none()), count(|step| step.after.is_none()));
    let constants: usize = diff.steps.iter().flat_map(|step| &step.constants).map(|c| c.different_bytes).sum();
    let changed = diff.steps.len() - added - removed;
    let _ = writeln!(
        text,
        "{changed} steps changed, {added} added, {removed} removed; {constants} bytes of constants differ"
    );
    text
}

fn row(change: &Change) -> [String; 3] {
    let value = |value: &Option<String>| value.clone().unwrap_or_else(|| "-".into());
    [change.what.clone(), value(&change.before), value(&change.after)]
}

fn step_rows(step: &StepChange) -> Vec<[String; 5]> {
    let position = match (step.before, step.after) {
        (Some(before), Some(after)) if before == after => before.to_string(),
        (Some(before), Some(after)) => format!("{before} → {after}"),
        (Some(before), None) => format!("- {before}"),
        (None, Some(after)) => format!("+ {after}"),
        (None, None) => String::new(),
    };
    let mut rows: Vec<[String; 3]> = step.fields.iter().map(row).collect();
    rows.extend(step.constants.iter().map(|constant| {
        let (before, after) = (constant.before_bytes, constant.after_bytes);
        [constant.what.clone(), format!("{before} B"), format!("{after} B, {} differ", constant.different_bytes)]
    }));
    rows.extend(step.answer.then(|| ["known answer".into(), String::new(), "differs".into()]));
    // Step and operator stand in the first row of each step only.
    let first = |index: usize, text: &str| if index == 0 { text.to_owned() } else { String::new() };
    let rows = rows.into_iter().enumerate();
    rows.map(|(i, [what, before, after])| [first(i, &position), first(i, step.op), what, before, after]).collect()
}
