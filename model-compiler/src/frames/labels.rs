//! `labels.csv` beside the images of a directory: what is to be seen on each.
//!
//! ```text
//! file,label,name
//! 0000.png,3,cat
//! 0001.png,8,ship
//! ```
//!
//! A line per image: its file name, the index of its class (the index of the network's output) and, optionally, what
//! people call the class. Fields are divided by commas, without quotes; a header line may come first; empty lines do
//! not count. Where there are labels, every image has one.

use crate::error::{Error, ErrorCode, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Name of the file.
pub const FILE: &str = "labels.csv";
const HELP: &str = "a line is FILE,LABEL or FILE,LABEL,NAME, such as 0000.png,3,cat";

/// What an image shows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Label {
    /// Index of the network's output.
    pub class: u16,
    /// What people call the class; may be empty.
    pub name: String,
}

/// The labels of the files `images` in `folder`, in their order; `None` where the folder has no labels.
///
/// # Errors
/// A line that is malformed, names a file that is not there or named before, or a class that the network does not
/// know; an image without a line. File and line are named.
pub(super) fn read(folder: &Path, images: &[String], classes: u16) -> Result<Option<Vec<Label>>> {
    let path = folder.join(FILE);
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(Error::io(&path, &e)),
    };
    parse(&text, images, classes).map(Some).map_err(|e| e.within(path.display()))
}

fn parse(text: &str, images: &[String], classes: u16) -> Result<Vec<Label>> {
    let known: BTreeSet<&str> = images.iter().map(String::as_str).collect();
    let mut labels: BTreeMap<&str, (usize, Label)> = BTreeMap::new();
    let mut names: BTreeMap<u16, (usize, &str)> = BTreeMap::new();
    for (number, line) in numbered_lines(text) {
        let refuse = |message: String| Error::new(ErrorCode::Frames, format!("line {number}"), message);
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        let (file, class, name) = match fields[..] {
            [file, class] => (file, class, ""),
            [file, class, name] => (file, class, name),
            _ => return Err(refuse(format!("found {} fields, expected 2 or 3", fields.len())).with_help(HELP)),
        };
        let index = class.parse::<u32>();
        if index.is_err() && number == 1 && !known.contains(file) {
            continue;
        }
        let index = index.map_err(|_| refuse(format!("label {class:?}, expected a whole number")).with_help(HELP))?;
        let class = u16::try_from(index).ok().filter(|&class| class < classes).ok_or_else(|| {
            refuse(format!("label {index}, the network has classes 0..={}", classes.saturating_sub(1)))
                .with_help("labels are indices of the network's outputs, counted from 0")
        })?;
        let &file = known.get(file).ok_or_else(|| {
            refuse(format!("no image {file:?} in this folder")).with_help("remove the line, or add the image")
        })?;
        if let Some((first, _)) = labels.get(file) {
            return Err(refuse(format!("{file} has a label already, in line {first}")).with_help("keep one of them"));
        }
        match names.get(&class) {
            Some((first, called)) if !name.is_empty() && *called != name => {
                let message = format!("class {class} is called {name:?} here and {called:?} in line {first}");
                return Err(refuse(message).with_help("give a class one name"));
            }
            None if !name.is_empty() => drop(names.insert(class, (number, name))),
            _ => {}
        }
        labels.insert(file, (number, Label { class, name: name.to_owned() }));
    }
    let label = |image: &String| {
        labels.remove(image.as_str()).map(|(_, label)| label).ok_or_else(|| {
            Error::new(ErrorCode::Frames, "", format!("no line for the image {image}"))
                .with_help(format!("label every image, or remove {FILE}: accuracy over a part would mislead"))
        })
    };
    images.iter().map(label).collect()
}

/// Lines that hold something, counted from 1.
fn numbered_lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    text.lines().enumerate().map(|(i, line)| (i + 1, line.trim())).filter(|(_, line)| !line.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(text: &str) -> Result<Vec<Label>> {
        parse(text, &["a.png".into(), "b.png".into()], 10)
    }

    #[test]
    fn labels_follow_the_images_whatever_the_order_of_lines() {
        let label = |class, name: &str| Label { class, name: name.into() };
        let both = labels("file,label,name\r\nb.png, 9,truck\r\n\r\na.png,0,airplane\r\n").unwrap();
        assert_eq!(both, [label(0, "airplane"), label(9, "truck")]);
        assert_eq!(labels("\u{feff}a.png,3\nb.png,3").unwrap(), [label(3, ""), label(3, "")]);
    }

    #[test]
    fn every_bad_line_is_named_with_found_and_expected() {
        for (text, expected) in [
            ("a.png,0\nb.png", "line 2: found 1 fields, expected 2 or 3"),
            ("a.png,0,x,y\nb.png,0", "line 1: found 4 fields, expected 2 or 3"),
            ("a.png,cat\nb.png,0", "line 1: label \"cat\", expected a whole number"),
            ("file,label\na.png,-1\nb.png,0", "line 2: label \"-1\", expected a whole number"),
            ("a.png,10\nb.png,0", "line 1: label 10, the network has classes 0..=9"),
            ("a.png,70000\nb.png,0", "line 1: label 70000, the network has classes 0..=9"),
            ("a.png,1\nb.png,0\nc.png,0", "line 3: no image \"c.png\" in this folder"),
            ("a.png,1\nb.png,0\n\na.png,1", "line 4: a.png has a label already, in line 1"),
            ("a.png,1,car\nb.png,1,bird", "line 2: class 1 is called \"bird\" here and \"car\" in line 1"),
            ("file,label\na.png,1", "no line for the image b.png"),
            ("", "no line for the image a.png"),
        ] {
            let error = labels(text).unwrap_err();
            assert!(error.to_string().starts_with(expected), "{text:?}: {error}");
            assert!(!error.help.is_empty(), "{error}");
        }
    }
}
