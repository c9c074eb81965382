//! Figures as people read them, in text and on the page.

/// A figure with so many digits; `–` where there is none.
pub(crate) fn figure(value: Option<f64>, digits: usize) -> String {
    match value {
        None => "–".to_owned(),
        Some(value) if value == f64::INFINITY => "exact".to_owned(),
        Some(value) if value.is_nan() => "not a number".to_owned(),
        Some(value) => format!("{value:.digits$}").replace('-', "−"),
    }
}

/// Decibels with their unit.
pub(crate) fn decibels(value: Option<f64>) -> String {
    match value {
        Some(db) if db.is_finite() => format!("{} dB", figure(value, 1)),
        _ => figure(value, 1),
    }
}

/// A difference with its sign.
pub(crate) fn signed(value: Option<f64>, digits: usize) -> String {
    match value {
        Some(value) if value == f64::NEG_INFINITY => "was exact".to_owned(),
        Some(value) if value == f64::INFINITY => "now exact".to_owned(),
        // What rounds to zero has no sign.
        Some(value) if value.abs() < 0.5 * 0.1_f64.powi(digits as i32) => format!("{:.digits$}", 0.0),
        Some(value) if value.is_finite() => format!("{value:+.digits$}").replace('-', "−"),
        _ => figure(value, digits),
    }
}

/// Bytes in groups of three digits.
pub(crate) fn bytes(bytes: u64) -> String {
    let digits = bytes.to_string();
    let groups: Vec<&str> = digits.as_bytes().rchunks(3).rev().map(|g| std::str::from_utf8(g).unwrap_or("")).collect();
    format!("{}\u{202f}B", groups.join("\u{202f}"))
}

/// Bytes in their largest unit, for axes.
pub(crate) fn short_bytes(bytes: f64) -> String {
    match bytes {
        b if b >= 1_048_576.0 => {
            format!("{:.4}", b / 1_048_576.0).trim_end_matches('0').trim_end_matches('.').to_owned() + " MiB"
        }
        b if b >= 1024.0 => format!("{:.1}", b / 1024.0).trim_end_matches(".0").to_owned() + " KiB",
        b => format!("{b:.0} B"),
    }
}

/// A real value in few characters.
pub(crate) fn value(value: f64) -> String {
    let magnitude = value.abs();
    let text = match magnitude {
        0.0 => "0".to_owned(),
        m if !(1e-3..1e5).contains(&m) => format!("{value:.1e}"),
        m if m >= 100.0 => format!("{value:.0}"),
        m if m >= 1.0 => format!("{value:.2}"),
        _ => format!("{value:.4}"),
    };
    text.replace('-', "−")
}

/// The end of a dotted name that still says something: `blocks.0` of `encoder.blocks.0`.
pub(crate) fn short_name(name: &str) -> &str {
    let is_number = |part: &str| part.bytes().all(|byte| byte.is_ascii_digit());
    let mut start = name.len();
    for part in name.rsplit('.') {
        start -= part.len();
        if !is_number(part) {
            break;
        }
        start = start.saturating_sub(1);
    }
    &name[start..]
}

/// `64×64×16`.
pub(crate) fn shape([height, width, channels]: [u16; 3]) -> String {
    format!("{height}×{width}×{channels}")
}

/// `2, 3, 4`.
pub(crate) fn listed(numbers: &[u16]) -> String {
    let numbers: Vec<String> = numbers.iter().map(u16::to_string).collect();
    numbers.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_short_and_signs_are_signs() {
        assert_eq!((decibels(Some(12.34)), decibels(Some(f64::INFINITY))), ("12.3 dB".into(), "exact".into()));
        assert_eq!((figure(None, 1), figure(Some(f64::NAN), 1)), ("–".into(), "not a number".into()));
        assert_eq!((signed(Some(-1.26), 1), signed(Some(f64::NEG_INFINITY), 1)), ("−1.3".into(), "was exact".into()));
        assert_eq!(
            (signed(Some(-0.04), 1), signed(Some(0.0), 0), signed(None, 1)),
            ("0.0".into(), "0".into(), "–".into())
        );
        assert_eq!((bytes(1_572_876), bytes(12)), ("1\u{202f}572\u{202f}876\u{202f}B".into(), "12\u{202f}B".into()));
        assert_eq!((short_bytes(1_572_864.0), short_bytes(65_536.0)), ("1.5 MiB".into(), "64 KiB".into()));
        assert_eq!((short_name("a.layer1.0"), short_name("a.relu"), short_name("7")), ("layer1.0", "relu", "7"));
        assert_eq!((value(0.0), value(-0.5), value(12345.0)), ("0".into(), "−0.5000".into(), "12345".into()));
    }
}
