//! Claims about whole pages.

use super::*;
use crate::compare::StepDifference;
use crate::noise::NoiseShare;
use crate::noise::NoiseShares;
use crate::report::StepReport;
use crate::report::tests::{report, step};
use model_compiler::frames::ByteMap;
use model_compiler::ir::Shape;

const HOSTILE: &str = "<script>alert('1')</script>\"&'>";

/// Elements that have no end tag in HTML.
const VOID: [&str; 3] = ["meta", "img", "wbr"];

/// A report in which every text of a file is hostile, with everything that a page can show.
fn hostile() -> VerifyReport {
    let mut report = report();
    report.baseline = Some(crate::diff::tests::diff());
    report.noise = Some(NoiseShares {
        frame: HOSTILE.into(),
        measured: HOSTILE.into(),
        measured_sqnr_db: Some(20.0),
        candidates: 7,
        shares: vec![NoiseShare { position: 0, step: HOSTILE.into(), share: 1.0, alone_sqnr_db: None }],
    });
    report.first_difference = Some(StepDifference {
        frame: HOSTILE.into(),
        position: 0,
        step: HOSTILE.into(),
        tensor: HOSTILE.into(),
        index: 0,
        at: [0; 3],
        found: Some(1),
        expected: Some(2),
        differing: 1,
        elements: 4,
    });
    report.check(crate::gates::Gates { min_sqnr_db: Some(90.0), ..Default::default() }.outcomes(&report).unwrap());
    report.untrained = true;
    report.model.name = HOSTILE.into();
    report.target = HOSTILE.into();
    report.calibration_frames = vec![HOSTILE.into()];
    for step in &mut report.steps {
        step.step = HOSTILE.into();
        step.tensor = HOSTILE.into();
    }
    for buffer in &mut report.memory.buffers {
        buffer.name = HOSTILE.into();
        buffer.in_place_of = Some(HOSTILE.into());
    }
    for gate in &mut report.gates {
        gate.gate = HOSTILE.into();
        gate.place = Some(HOSTILE.into());
    }
    report.frames[0].name = HOSTILE.into();
    report.frames[0].dropped_points = 3;
    report
}

fn frame() -> Frame {
    Frame {
        name: HOSTILE.into(),
        rgb: Some(ByteMap { shape: Shape::map(4, 4, 3), data: (0..48).collect() }),
        bev: Some(ByteMap { shape: Shape::map(4, 4, 2), data: vec![1; 32] }),
        velocity: Some(1.0),
        goal: Some([1.0, -20.0]),
        dropped_points: 3,
        ..Frame::default()
    }
}

/// Checks that every element is closed in order. Style and script hold no markup, so they are passed over.
fn assert_well_formed(page: &str) {
    let mut open: Vec<&str> = Vec::new();
    let mut rest = page.strip_prefix("<!DOCTYPE html>").expect("an HTML page");
    while let Some(start) = rest.find('<') {
        let text = &rest[..start];
        assert!(!text.contains('>'), "a stray > in {text:?}");
        let end = start + rest[start..].find('>').expect("every tag ends");
        let tag = &rest[start + 1..end];
        rest = &rest[end + 1..];
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop(), Some(name), "in {open:?}");
            continue;
        }
        let name = tag.split_whitespace().next().expect("a tag has a name");
        assert!(name.chars().all(|c| c.is_ascii_alphanumeric()), "{tag}");
        assert_eq!(tag.matches('"').count() % 2, 0, "{tag}");
        if !VOID.contains(&name) {
            open.push(name);
        }
        if ["style", "script"].contains(&name) {
            let close = format!("</{name}>");
            rest = &rest[rest.find(&close).expect("it is closed")..];
        }
    }
    assert!(open.is_empty(), "{open:?}");
}

#[test]
fn every_element_is_closed() {
    let plain = report();
    assert_well_formed(&page(&plain, &[frame()]));
    assert_well_formed(&page(&hostile(), &[frame()]));
    assert_well_formed(&diff_page(&crate::diff::tests::diff(), &[]));
}

#[test]
fn text_from_files_is_escaped() {
    let page = page(&hostile(), &[frame()]);
    assert_eq!(page.matches("<script>").count(), 1, "the page's own");
    assert!(!page.contains("alert('1')</script>"));
    assert!(page.matches("&lt;script&gt;").count() > 20);
}

#[test]
fn nothing_is_fetched() {
    let page = page(&hostile(), &[frame()]).replace("data:image/png;base64,", "");
    for forbidden in ["http", "//", "url(", "@import", "<link", "<iframe", "src=\"/", "fetch("] {
        let own = page.replace("url(#hatch)", "").replace("// Tables", "").replace("// Tensors", "");
        assert!(!own.contains(forbidden), "{forbidden}");
    }
}

#[test]
fn sections_that_do_not_apply_are_absent() {
    let mut bare = report();
    bare.frames[0].waypoints = None;
    bare.frames[0].reference_waypoints = None;
    bare.frames[0].worst_sqnr_db = None;
    bare.summary.waypoint_error_mm.clear();
    bare.summary.vector_sqnr_db = None;
    for step in &mut bare.steps {
        (step.sqnr_db, step.local_sqnr_db, step.channels) = (None, None, None);
    }
    let page = page(&bare, &[frame()]);
    assert_well_formed(&page);
    for id in ["waypoints", "frames", "sqnr", "noise", "channels", "changes", "gates"] {
        assert!(!page.contains(&format!("<section id=\"{id}\"")), "{id}");
    }
    for id in ["tensors", "memory", "steps"] {
        assert!(page.contains(&format!("<section id=\"{id}\"")), "{id}");
    }
    assert!(!page.contains("Waypoint error") && !page.contains("Pooled vector"));
}

#[test]
fn what_must_be_known_is_said() {
    let page = page(&hostile(), &[frame()]);
    for expected in ["✗ Failed", "Untrained network", "1 of 1 frames are also calibration frames", "3 LiDAR points"] {
        assert!(page.contains(expected), "{expected}");
    }
    assert!(page.contains("Measured: the 1 steps with the lowest SQNR alone, of 7"));
    assert!(super::page(&report(), &[]).contains("✓ Passed"));
}

#[test]
fn figures_that_are_infinite_or_none_are_words() {
    let mut exact = report();
    exact.steps[0].sqnr_db = Some(f64::INFINITY);
    exact.steps[1].local_sqnr_db = Some(f64::NAN);
    let page = page(&exact, &[]);
    assert!(page.contains("exact") && page.contains("not a number"));
    let (_, shown) = page.split_once("<body>").unwrap();
    let shown = shown.split("<script>").next().unwrap();
    assert!(!shown.contains("NaN") && !shown.contains("inf"), "no bare float words in paths or tables");
}

#[test]
fn a_large_network_stays_below_three_megabytes() {
    let mut large = report();
    let counts: Vec<u64> = (0..64_u64).map(|i| i.wrapping_mul(0x9E37_79B9) % 100_000).collect();
    let name = |i: usize| format!("encoder.transformer{}.blocks.{i}.attn.query", i % 4);
    let ranges: Vec<f32> = (0..2048_u16).map(|i| f32::from(i).sin()).collect();
    large.steps = (0..400)
        .map(|i| StepReport {
            step: name(i),
            tensor: name(i),
            histogram: Some(crate::histogram::Histogram {
                first: -3.0,
                width: 0.1,
                float: counts.clone(),
                codes: counts.iter().rev().copied().collect(),
            }),
            channels: Some(crate::channels::Channels {
                weight_scale: ranges.clone(),
                min: ranges.iter().map(|v| -v.abs()).collect(),
                max: ranges.iter().map(|v| v.abs()).collect(),
            }),
            ..step(i, Some(20.0 + (i as f64).cos()))
        })
        .collect();
    let page = page(&large, &vec![frame(); 4]);
    assert!(page.len() < 3_000_000, "{} B", page.len());
}
