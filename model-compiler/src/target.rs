//! Targets: what a plan must fit, as data. A new chip is a new description, not new code.
//!
//! Built in are families without sizes; `--ram` or `--region`, and `--flash`, or a TOML file add them:
//!
//! ```toml
//! name = "my-board"        # at most 16 visible ASCII characters; the image carries it
//! alignment = 4            # of tensors, bytes; a power of two
//! flash = "2M"             # bytes, or with K or M (1024, 1024²); absent: unlimited
//! kernels = ["direct"]     # or "k4n16": what the runtime there has, the best first; absent: direct
//!
//! [[regions]]              # RAM, one to four memories, the fastest first
//! name = "main"
//! bytes = "1536K"          # absent: unlimited
//! ```

use crate::error::{Error, ErrorCode, Result};
use crate::memory_plan::{ArenaPart, MemoryPlan, PlanStatus};
use crate::qmodel::QModel;
use firmware::image::layout::header;
use firmware::image::{RegionName, layout};
use firmware::kernels::plan;
use firmware::program::KernelId;
use serde::Deserialize;
use std::fmt::Write as _;
use std::path::Path;

/// A kind of machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Target {
    /// Name in messages and records.
    pub name: String,
    /// RAM: one to four regions of distinct names, the fastest first; the arena is spread over them.
    pub regions: Vec<Region>,
    /// Room for the image, bytes; `None`: unlimited.
    pub flash_bytes: Option<u64>,
    /// Alignment of tensors in the arena, bytes.
    pub alignment: u32,
    /// Kernels that the runtime there has, the best first.
    pub kernels: Vec<KernelId>,
}

/// A named memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Region {
    /// `main`, `fast`, `slow`: 1 to 8 visible ASCII characters.
    pub name: String,
    /// Size; `None`: unlimited.
    pub bytes: Option<u64>,
}

/// Built-in names with the alignment of tensors and the kernels.
const BUILT_IN: [(&str, u32, &[KernelId]); 6] = [
    ("portable", 4, &[KernelId::Direct]),
    ("x86", 64, &[KernelId::K4N16, KernelId::Direct]),
    ("cortex-m4", 4, &[KernelId::Direct]),
    ("cortex-m7", 4, &[KernelId::Direct]),
    ("cortex-m55", 4, &[KernelId::Direct]),
    ("cortex-a", 16, &[KernelId::Direct]),
];

/// Kernels as descriptions name them.
const KERNELS: [(&str, KernelId); 2] = [("direct", KernelId::Direct), ("k4n16", KernelId::K4N16)];

/// Buffers listed in a message at most.
const MAX_LISTED: usize = 12;

impl Target {
    /// A built-in target, or one read from a `.toml` file.
    ///
    /// # Errors
    /// Unknown name, unreadable file, or a file that is no target.
    pub fn find(name: &str) -> Result<Self> {
        if let Some(&(name, alignment, kernels)) = BUILT_IN.iter().find(|built_in| built_in.0 == name) {
            return Ok(Self {
                name: name.into(),
                regions: vec![Region { name: "main".into(), bytes: None }],
                flash_bytes: None,
                alignment,
                kernels: kernels.to_vec(),
            });
        }
        if Path::new(name).extension().is_none_or(|e| e != "toml") {
            let names: Vec<&str> = BUILT_IN.iter().map(|b| b.0).collect();
            return Err(Error::new(ErrorCode::Usage, "--target", format!("unknown target '{name}'"))
                .with_help(format!("use one of {}, or a file FILE.toml", names.join(", "))));
        }
        let text = std::fs::read_to_string(name).map_err(|e| Error::io(Path::new(name), &e))?;
        Self::parse(&text).map_err(|e| e.within(name))
    }

    /// Reads a description; the format is on the module page.
    ///
    /// # Errors
    /// Not TOML, unknown or missing fields, or values out of range.
    pub fn parse(text: &str) -> Result<Self> {
        let file: File = toml::from_str(text).map_err(|e| {
            Error::new(ErrorCode::Malformed, "", e.to_string().trim_end())
                .with_help("fields: name, alignment, flash, kernels, [[regions]] with name and bytes")
        })?;
        let is_plain = file.name.bytes().all(|byte| byte.is_ascii_graphic());
        if !is_plain || !(1..=header::TARGET.len()).contains(&file.name.len()) {
            let message =
                format!("found '{}', expected 1 to {} visible ASCII characters", file.name, header::TARGET.len());
            return Err(Error::new(ErrorCode::Malformed, "name", message));
        }
        if !file.alignment.is_power_of_two() || !(4..=4096).contains(&file.alignment) {
            let message = format!("found {}, expected a power of two from 4 to 4096", file.alignment);
            return Err(Error::new(ErrorCode::Malformed, "alignment", message));
        }
        let kernels = file.kernels.unwrap_or_else(|| vec!["direct".into()]);
        if kernels.is_empty() {
            return Err(Error::new(ErrorCode::Malformed, "kernels", "found none, expected at least one"));
        }
        let region = |r: RegionFile| {
            let bytes = r.bytes.map(|b| b.bytes(&format!("region {}", r.name))).transpose()?;
            Ok(Region { name: r.name, bytes })
        };
        let regions: Vec<Region> = file.regions.into_iter().map(region).collect::<Result<_>>()?;
        check_regions(&regions).map_err(|message| Error::new(ErrorCode::Malformed, "regions", message))?;
        Ok(Self {
            name: file.name,
            regions,
            flash_bytes: file.flash.map(|f| f.bytes("flash")).transpose()?,
            alignment: file.alignment,
            kernels: kernels.iter().map(|k| kernel(k)).collect::<Result<_>>()?,
        })
    }

    /// The target with other memories (`--region`), the fastest first.
    ///
    /// # Errors
    /// None or more than four, a name that an image cannot hold, or one that occurs twice.
    pub fn with_regions(self, regions: Vec<Region>) -> Result<Self> {
        check_regions(&regions).map_err(|message| Error::new(ErrorCode::Usage, "--region", message))?;
        Ok(Self { regions, ..self })
    }

    /// The target with other limits where given (`--ram`, `--flash`); RAM is the first region's.
    #[must_use]
    pub fn with_limits(mut self, ram_bytes: Option<u64>, flash_bytes: Option<u64>) -> Self {
        if let (Some(region), Some(bytes)) = (self.regions.first_mut(), ram_bytes) {
            region.bytes = Some(bytes);
        }
        self.flash_bytes = flash_bytes.or(self.flash_bytes);
        self
    }

    /// The kernel of a weighted step with so many channel groups and output channels: the first that suits it, else the
    /// first of all. `None` where the target lists none.
    pub fn kernel_for(&self, groups: u16, outputs: u16) -> Option<KernelId> {
        let suited = self.kernels.iter().find(|kernel| plan::suits(**kernel, groups, outputs));
        suited.or(self.kernels.first()).copied()
    }

    /// Whether plan and image fit.
    ///
    /// # Errors
    /// `TooBig`: what is too big by how much; for the arena also the step at the peak and what is live there, for one
    /// in several regions also what the others hold and what all need together.
    pub fn fits(&self, model: &QModel, plan: &MemoryPlan, image_bytes: u64) -> Result<()> {
        let parts = (0_u8..).zip(&plan.regions).zip(&self.regions);
        let mut limits = parts.filter_map(|((number, part), region)| Some((number, part, region.bytes?)));
        if let Some((region, part, limit)) = limits.find(|(_, part, limit)| part.bytes > *limit) {
            let (what, others, help) = match plan.regions.as_slice() {
                [_] => ("arena".to_owned(), String::new(), help(part)),
                parts => (format!("arena in region {}", part.name), others(parts, region), help_of_many(model, plan)),
            };
            let details = others + &live_list(model, plan, region);
            return Err(self.too_big(&what, part.bytes, limit, &details).with_help(help));
        }
        if let Some(limit) = self.flash_bytes.filter(|&limit| image_bytes > limit) {
            let help = "use a target with more flash (--flash), or a smaller network";
            return Err(self.too_big("image", image_bytes, limit, "").with_help(help));
        }
        Ok(())
    }

    fn too_big(&self, what: &str, needed: u64, limit: u64, details: &str) -> Error {
        let over = needed - limit;
        let message = format!("the {what} needs {needed} bytes, {limit} are there: {over} too many{details}");
        Error::new(ErrorCode::TooBig, format!("target {}", self.name), message)
    }
}

/// Parses a size: bytes, or with `K` or `M` (1024, 1024²).
///
/// # Errors
/// Not a whole number, or beyond 64 bits.
pub fn parse_size(text: &str) -> Result<u64> {
    let trimmed = text.trim();
    let (digits, unit) = match trimmed.as_bytes().last() {
        Some(b'K' | b'k') => (&trimmed[..trimmed.len() - 1], 1 << 10),
        Some(b'M' | b'm') => (&trimmed[..trimmed.len() - 1], 1 << 20),
        _ => (trimmed, 1),
    };
    let plain = !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit());
    let value = digits.parse::<u64>().ok().filter(|_| plain).and_then(|n| n.checked_mul(unit));
    value.ok_or_else(|| {
        Error::new(ErrorCode::Usage, "", format!("found '{text}', expected a number of bytes"))
            .with_help("for example 524288, 512K or 2M")
    })
}

fn kernel(name: &str) -> Result<KernelId> {
    let known = KERNELS.iter().find(|(known, _)| *known == name);
    known.map(|(_, kernel)| *kernel).ok_or_else(|| {
        let names = KERNELS.map(|(name, _)| format!("'{name}'")).join(" or ");
        Error::new(ErrorCode::Malformed, "kernels", format!("found '{name}', expected {names}"))
    })
}

/// What an image can hold: one to four regions, names of visible ASCII, none twice.
fn check_regions(regions: &[Region]) -> std::result::Result<(), String> {
    if regions.is_empty() {
        return Err("found none, expected at least one".into());
    }
    if regions.len() > layout::REGION_SLOTS {
        return Err(format!("found {}, expected at most {}", regions.len(), layout::REGION_SLOTS));
    }
    for (number, Region { name, .. }) in regions.iter().enumerate() {
        if RegionName::new(name).is_none() {
            return Err(format!("found the name {name:?}, expected 1 to 8 visible ASCII characters"));
        }
        if regions[..number].iter().any(|other| other.name == *name) {
            return Err(format!("found the name {name:?} twice, expected each once"));
        }
    }
    Ok(())
}

fn help(part: &ArenaPart) -> String {
    let proof = match part.status {
        PlanStatus::Optimal => "no plan for this order is smaller".to_string(),
        PlanStatus::OptimalBoundNotReachable => format!("no plan is smaller; the bound is {}", part.bound_bytes),
        PlanStatus::NodeLimit => format!("the search was cut short; the bound is {}", part.bound_bytes),
    };
    format!("use a target with more RAM (--ram), or a smaller network; {proof}")
}

/// What all regions have, against what is live at once.
fn help_of_many(model: &QModel, plan: &MemoryPlan) -> String {
    let all = |position: u32| (0_u8..).zip(&plan.regions).map(|(r, _)| plan.live_bytes(r, position)).sum::<u64>();
    let fullest = (0..plan.order.len() as u32).max_by_key(|&p| (all(p), std::cmp::Reverse(p))).unwrap_or(0);
    let room: u64 = plan.regions.iter().filter_map(|part| part.capacity).sum();
    let step = plan.order.get(fullest as usize).map_or("", |&step| &model.steps[step as usize].name);
    format!(
        "give the regions more bytes (--region), or use a smaller network; at step {fullest} ({step}) {} bytes are live \
         at once, all regions together have {room}",
        all(fullest)
    )
}

/// A line for each other region.
fn others(parts: &[ArenaPart], region: u8) -> String {
    let line = |(_, part): (u8, &ArenaPart)| match part.capacity {
        Some(capacity) => format!("\nregion {} holds {} of {capacity} bytes", part.name, part.bytes),
        None => format!("\nregion {} holds {} bytes", part.name, part.bytes),
    };
    (0_u8..).zip(parts).filter(|(number, _)| *number != region).map(line).collect()
}

/// The peak step of a region and its live buffers there, largest first, in columns.
fn live_list(model: &QModel, plan: &MemoryPlan, region: u8) -> String {
    let Some(peak) = plan.regions.get(usize::from(region)).map(|part| part.peak_step) else { return String::new() };
    let Some(&step) = plan.order.get(peak as usize) else { return String::new() };
    let mut live: Vec<(String, u64)> = model
        .tensors
        .iter()
        .zip(&plan.tensors)
        .filter(|(_, p)| p.region == region && (p.first_step..=p.last_step).contains(&peak))
        .map(|(t, p)| {
            let shared = p.in_place_of.filter(|_| p.first_step == peak);
            let note = shared.map(|o| format!(" (over {})", model.tensor(o).name)).unwrap_or_default();
            (format!("{}{note}", t.name), p.bytes)
        })
        .collect();
    let scratch = plan.scratch[peak as usize].iter().filter(|p| p.region == region);
    live.extend(scratch.map(|p| ("scratch".to_string(), p.bytes)));
    live.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
    let mut text = format!("\nat the peak, step {} ({}), these are live:", peak, model.steps[step as usize].name);
    let width = live.iter().take(MAX_LISTED).map(|(name, _)| name.len()).max().unwrap_or(0);
    for (name, bytes) in live.iter().take(MAX_LISTED) {
        let _ = write!(text, "\n  {name:width$}  {bytes:>10}");
    }
    if live.len() > MAX_LISTED {
        let rest: u64 = live[MAX_LISTED..].iter().map(|l| l.1).sum();
        let _ = write!(text, "\n  {:width$}  {rest:>10}", format!("{} more", live.len() - MAX_LISTED));
    }
    text
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    name: String,
    alignment: u32,
    flash: Option<Size>,
    kernels: Option<Vec<String>>,
    #[serde(default)]
    regions: Vec<RegionFile>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RegionFile {
    name: String,
    bytes: Option<Size>,
}

#[derive(Deserialize)]
#[serde(untagged, expecting = "expected a number of bytes, or text such as \"512K\"")]
enum Size {
    Bytes(u64),
    Text(String),
}

impl Size {
    fn bytes(self, place: &str) -> Result<u64> {
        match self {
            Self::Bytes(bytes) => Ok(bytes),
            Self::Text(text) => parse_size(&text).map_err(|e| e.within(place)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_suffixes() {
        assert_eq!(parse_size("1536K"), Ok(1_572_864));
        assert_eq!(parse_size(" 2M "), Ok(2 << 20));
        assert_eq!(parse_size("77"), Ok(77));
        for bad in ["", "K", "-1", "+1", "1.5M", "2G", "18446744073709551615K", "é"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn built_in_targets_are_unlimited_until_limits_are_set() {
        for (name, alignment, _) in BUILT_IN {
            let target = Target::find(name).unwrap();
            let main = |bytes| vec![Region { name: "main".into(), bytes }];
            assert_eq!((target.alignment, target.flash_bytes), (alignment, None), "{name}");
            assert_eq!(target.regions, main(None));
            let small = target.with_limits(Some(1), Some(2));
            assert_eq!((small.regions, small.flash_bytes), (main(Some(1)), Some(2)));
        }
        let error = Target::find("cortex-m5").unwrap_err();
        assert!(error.message.contains("'cortex-m5'") && error.help.contains("cortex-m55"), "{error}");
        assert_eq!(Target::find("absent.toml").unwrap_err().code, ErrorCode::Io);
    }

    const BOARD: &str = "name = 'b'\nalignment = 16\nflash = '2M'\n[[regions]]\nname = 'main'\nbytes = 1000\n";

    #[test]
    fn reads_a_description() {
        let target = Target::parse(BOARD).unwrap();
        let regions = vec![Region { name: "main".into(), bytes: Some(1000) }];
        let kernels = vec![KernelId::Direct];
        let expected = Target { name: "b".into(), regions, flash_bytes: Some(2 << 20), alignment: 16, kernels };
        assert_eq!(target, expected);
    }

    #[test]
    fn several_regions_keep_their_order() {
        let text = format!("{BOARD}[[regions]]\nname = 'slow'\n");
        let target = Target::parse(&text).unwrap();
        let region = |name: &str, bytes| Region { name: name.into(), bytes };
        assert_eq!(target.regions, [region("main", Some(1000)), region("slow", None)]);
        let regions = vec![region("fast", Some(64)), region("main", Some(128))];
        assert_eq!(target.clone().with_regions(regions.clone()).unwrap().regions, regions);
        let names = |names: &[&str]| names.iter().map(|name| region(name, Some(1))).collect::<Vec<_>>();
        for (bad, reason) in [
            (names(&[]), "found none"),
            (names(&["a", "b", "c", "d", "e"]), "found 5, expected at most 4"),
            (names(&["a", "b", "a"]), "\"a\" twice"),
            (names(&["nine_long"]), "\"nine_long\", expected 1 to 8"),
            (names(&[""]), "1 to 8 visible"),
        ] {
            let error = target.clone().with_regions(bad).unwrap_err();
            assert!(error.location == "--region" && error.message.contains(reason), "{reason} not in: {error}");
        }
    }

    #[test]
    fn the_first_kernel_that_suits_a_step_is_chosen() {
        let x86 = Target::find("x86").unwrap();
        assert_eq!(x86.kernel_for(1, 64), Some(KernelId::K4N16));
        assert_eq!(x86.kernel_for(64, 64), Some(KernelId::Direct), "depthwise");
        let only = Target::parse(&BOARD.replace("flash = '2M'", "kernels = ['k4n16']")).unwrap();
        assert_eq!(only.kernel_for(64, 64), Some(KernelId::K4N16));
        assert_eq!(Target { kernels: vec![], ..only }.kernel_for(1, 1), None);
    }

    #[test]
    fn refuses_descriptions_with_a_reason() {
        let cases = [
            (BOARD.replace("flash", "falsh"), "falsh"),
            (BOARD.replace("'b'", "''"), "name"),
            (BOARD.replace("'b'", "'a board'"), "'a board'"),
            (BOARD.replace("'b'", "'a-name-too-long-x'"), "1 to 16"),
            (BOARD.replace("= 16", "= 12"), "alignment"),
            (BOARD.replace("'2M'", "'2X'"), "flash"),
            (BOARD.replace("1000", "-5"), "bytes"),
            (BOARD.replace("flash = '2M'", "kernels = ['amx']"), "amx"),
            (BOARD.replace("flash = '2M'", "kernels = []"), "kernels"),
            (BOARD.lines().take(3).collect::<Vec<_>>().join("\n"), "regions"),
            (format!("{BOARD}[[regions]]\nname = 'main'\n"), "\"main\" twice"),
            (BOARD.replace("'main'", "'main memory'"), "\"main memory\""),
            (BOARD.lines().skip(1).collect::<Vec<_>>().join("\n"), "name"),
        ];
        for (text, reason) in cases {
            let error = Target::parse(&text).unwrap_err().to_string();
            assert!(error.contains(reason), "{reason} not in: {error}");
        }
    }
}
