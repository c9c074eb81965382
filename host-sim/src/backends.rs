//! The kernels that this machine can run, and the choice among them.

use firmware::kernels::{Kernels, Portable};
use model_compiler::error::{Error, ErrorCode, Result};
use std::fmt;

/// A set of instructions that the firmware's kernels can use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, clap::ValueEnum)]
pub enum BackendKind {
    /// Plain Rust: the norm.
    Portable,
    /// 256-bit vectors.
    Avx2,
    /// 512-bit vectors with 8-bit dot products.
    Avx512Vnni,
}

/// Kernels that exist on this machine. Every one gives the same bytes.
#[derive(Clone, Copy)]
pub struct Backend {
    kind: BackendKind,
    kernels: &'static dyn Kernels,
}

impl BackendKind {
    /// All kinds, each faster than the one before.
    pub const ALL: [Self; 3] = [Self::Portable, Self::Avx2, Self::Avx512Vnni];

    /// Name on the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Portable => "portable",
            Self::Avx2 => "avx2",
            Self::Avx512Vnni => "avx512-vnni",
        }
    }

    /// The kernels, where this machine has the instructions.
    pub fn detect(self) -> Option<Backend> {
        let kernels: Option<&'static dyn Kernels> = match self {
            Self::Portable => Some(&Portable),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => firmware::kernels::x86_64::Avx2::detect().map(forever),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Vnni => firmware::kernels::x86_64::Avx512Vnni::detect().map(forever),
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx2 | Self::Avx512Vnni => None,
        };
        kernels.map(|kernels| Backend { kind: self, kernels })
    }
}

/// A reference to a token, which has no bytes to leak.
#[cfg(target_arch = "x86_64")]
fn forever<K: Kernels + 'static>(token: K) -> &'static dyn Kernels {
    const { assert!(size_of::<K>() == 0) };
    Box::leak(Box::new(token))
}

impl Backend {
    /// Every backend of this machine, each faster than the one before.
    pub fn all() -> Vec<Self> {
        BackendKind::ALL.into_iter().filter_map(BackendKind::detect).collect()
    }

    /// The fastest one of this machine, or the one asked for.
    ///
    /// # Errors
    /// `Unsupported`: this machine lacks the instructions of the one asked for.
    pub fn choose(wanted: Option<BackendKind>) -> Result<Self> {
        Self::choose_among(&Self::all(), wanted)
    }

    fn choose_among(available: &[Self], wanted: Option<BackendKind>) -> Result<Self> {
        let Some(kind) = wanted else {
            let portable = Self { kind: BackendKind::Portable, kernels: &Portable };
            return Ok(available.last().copied().unwrap_or(portable));
        };
        let found = available.iter().copied().find(|backend| backend.kind == kind);
        found.ok_or_else(|| {
            let has: Vec<&str> = available.iter().map(|backend| backend.kind.name()).collect();
            let message = format!("this machine has no {}", kind.name());
            Error::new(ErrorCode::Unsupported, "--backend", message).with_help(format!("it has {}", has.join(", ")))
        })
    }

    /// Which one it is.
    pub fn kind(self) -> BackendKind {
        self.kind
    }

    /// Its kernels.
    pub fn kernels(self) -> &'static dyn Kernels {
        self.kernels
    }
}

impl fmt::Debug for Backend {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Backend({})", self.kind.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::ValueEnum;

    #[test]
    fn portable_is_everywhere_and_the_fastest_is_the_default() {
        let all = Backend::all();
        assert_eq!(all[0].kind(), BackendKind::Portable);
        assert_eq!(Backend::choose(None).unwrap().kind(), all[all.len() - 1].kind());
    }

    #[test]
    fn the_command_line_knows_the_names() {
        for kind in BackendKind::ALL {
            assert_eq!(BackendKind::from_str(kind.name(), false), Ok(kind));
        }
    }

    #[test]
    fn a_backend_above_the_machine_is_refused_with_what_it_has() {
        let small: Vec<Backend> = BackendKind::Portable.detect().into_iter().collect();
        let error = Backend::choose_among(&small, Some(BackendKind::Avx512Vnni)).unwrap_err();
        assert_eq!(error.to_string(), "--backend: this machine has no avx512-vnni\n  help: it has portable");
        assert_eq!(error.code.exit_status(), 2);
        assert_eq!(Backend::choose_among(&small, None).unwrap().kind(), BackendKind::Portable);
    }
}
