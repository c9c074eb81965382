//! Writes the header of the C interface, firmware/include/firmware.h.

use std::fs;
use tests::c_header;

fn main() -> std::io::Result<()> {
    let path = c_header::path();
    fs::create_dir_all(path.parent().expect("a folder"))?;
    fs::write(&path, c_header::generate())?;
    println!("written  {}", path.display());
    Ok(())
}
