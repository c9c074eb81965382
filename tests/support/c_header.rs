//! The header of the C interface, generated from `firmware/src/ffi.rs`.
//!
//! `cargo run -p tests --example make_c_header` writes it; `tests/ffi.rs` checks that the stored file is what this
//! module gives.

use cbindgen::{Builder, Config, EnumConfig, ExportConfig, Language, RenameRule, Style};
use std::fs;
use std::path::{Path, PathBuf};

/// Names in C of what Rust calls otherwise.
const NAMES: [(&str, &str); 15] = [
    ("Status", "fw_status"),
    ("EngineStorage", "fw_engine"),
    ("Region", "fw_region"),
    ("Bytes", "fw_bytes"),
    ("RegionNeed", "fw_region_need"),
    ("ImageInfo", "fw_image_info"),
    ("Element", "fw_element"),
    ("PortInfo", "fw_port"),
    ("ProgressInfo", "fw_progress"),
    ("WaypointQ16", "fw_waypoint"),
    ("ENGINE_WORDS", "FW_ENGINE_WORDS"),
    ("MAX_REGIONS", "FW_MAX_REGIONS"),
    ("MAX_WAYPOINTS", "FW_MAX_WAYPOINTS"),
    ("MODEL_NAME_BYTES", "FW_MODEL_NAME_BYTES"),
    ("PORT_NAME_BYTES", "FW_PORT_NAME_BYTES"),
];

/// The stored header.
pub fn path() -> PathBuf {
    firmware("include/firmware.h")
}

fn firmware(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("firmware").join(file)
}

/// The header as the sources have it.
///
/// # Panics
/// The sources cannot be read, or hold what C cannot say.
pub fn generate() -> String {
    let interface = firmware("src/ffi.rs");
    let page = fs::read_to_string(&interface).unwrap_or_else(|e| panic!("{}: {e}", interface.display()));
    let page = page.lines().map_while(|line| line.strip_prefix("//!"));
    // What marks code in the documentation is none in a comment.
    let page: Vec<&str> = page.filter(|line| !line.starts_with(" ```")).collect();
    let config = Config {
        language: Language::C,
        style: Style::Both,
        cpp_compat: true,
        usize_is_size_t: true,
        no_includes: true,
        sys_includes: vec!["stddef.h".into(), "stdint.h".into()],
        header: Some(format!("/*\n *{}\n *\n * Generated; not to be edited.\n */", page.join("\n *"))),
        include_guard: Some("FIRMWARE_H".into()),
        line_length: 120,
        tab_width: 4,
        enumeration: EnumConfig { rename_variants: RenameRule::QualifiedScreamingSnakeCase, ..EnumConfig::default() },
        export: ExportConfig {
            rename: NAMES.into_iter().map(|(rust, c)| (rust.into(), c.into())).collect(),
            ..ExportConfig::default()
        },
        ..Config::default()
    };
    let sources = ["src/ffi/types.rs", "src/ffi/status.rs", "src/ffi.rs"].map(firmware);
    let builder = sources.iter().fold(Builder::new().with_config(config), |builder, source| builder.with_src(source));
    let mut header = Vec::new();
    builder.generate().unwrap_or_else(|e| panic!("{e}")).write(&mut header);
    String::from_utf8(header).expect("text")
}
