//! Validation of OpenUSD: faults at which the reader stops, and those that readers tolerate.

use std::path::Path;

use super::{Finding, Severity};
use crate::format::usd::{Breach, breaches};
use crate::format::{Fault, FormatError};

/// Checks a layer, or that of a package.
pub(super) fn check(path: &Path) -> Result<Vec<Finding>, FormatError> {
    let finding = |Breach { code, is_error, fault }| {
        let severity = if is_error { Severity::Error } else { Severity::Warning };
        let Fault { location, expected, found } = fault;
        Finding { severity, code, location, expected, found }
    };
    Ok(breaches(path)?.into_iter().map(finding).collect())
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use crate::format::error::Location;
    use crate::format::test_scenes::{camera, random_scene};
    use crate::format::{usd, validate};

    const POINTS: &str = "point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.5)]";

    /// Two triangles with further attributes.
    fn mesh(points: &str, more: &str) -> String {
        format!(
            "(\n metersPerUnit = 1\n)\ndef Mesh \"m\" {{\n {points}\n int[] faceVertexCounts = [3, 3]\n \
             int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]\n {more}\n}}\n"
        )
    }

    /// Three splats of degree 0.
    fn splats(more: &str) -> String {
        format!(
            "(\n metersPerUnit = 1\n)\ndef ParticleField3DGaussianSplat \"s\" {{\n \
             point3f[] positions = [(0, 0, 0), (1, 0, 0), (0, 2, 0)]\n uniform int radiance:sphericalHarmonicsDegree = 0\n \
             {more}\n}}\n"
        )
    }

    /// Severity, code, place and content of each finding.
    fn findings(text: &str) -> Vec<String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.usda");
        std::fs::write(&path, format!("#usda 1.0\n{text}")).unwrap();
        let all = validate(&path).unwrap().findings;
        all.into_iter().map(|f| format!("{:?} {} {}{}", f.severity, f.code, f.location, f.found)).collect()
    }

    #[test]
    fn arrays_fit_their_interpolation() {
        let uvs = |count: usize, more: &str| {
            let values = vec!["(0, 0)"; count].join(", ");
            mesh(POINTS, &format!("texCoord2f[] primvars:st = [{values}] {more}"))
        };
        let counted = |text: &str| findings(text).into_iter().filter(|f| f.contains("USD_COUNT")).collect::<Vec<_>>();
        for (fits, interpolation) in
            [(1, "constant"), (2, "uniform"), (4, "vertex"), (4, "varying"), (6, "faceVarying")]
        {
            let more = format!("(interpolation = \"{interpolation}\")");
            assert_eq!(findings(&uvs(fits, &more)), Vec::<String>::new(), "{interpolation}");
            for count in [fits - 1, fits + 1] {
                let severity = if fits == 1 { "Warning" } else { "Error" };
                assert_eq!(counted(&uvs(count, &more)), [format!("{severity} USD_COUNT /m.primvars:st: {count}")]);
            }
        }
        assert_eq!(counted(&uvs(4, "")), ["Warning USD_COUNT /m.primvars:st: 4"], "constant, as nobody says");
        assert_eq!(counted(&uvs(4, "(interpolation = \"vertices\")")), ["Error USD_COUNT /m.primvars:st: `vertices`"]);
        let indexed = |indices: &str| {
            uvs(2, &format!("(interpolation = \"faceVarying\")\n int[] primvars:st:indices = [{indices}]"))
        };
        assert_eq!(counted(&indexed("0, 1, 0, 1, 1, 0")), Vec::<String>::new());
        assert_eq!(counted(&indexed("0, 1, 0")), ["Error USD_COUNT /m.primvars:st:indices: 3"]);
        assert_eq!(counted(&indexed("0, 1, 2, 0, 0, 0")), ["Error USD_COUNT /m.primvars:st:indices: 2"]);
        // Attributes that no reader here uses.
        let more = "normal3f[] normals = [(0, 0, 1)]\n string[] primvars:names = [\"a\", \"b\"] (interpolation = \"vertex\")\n \
                    float[] primvars:pairs = [1, 2, 3, 4] (\n elementSize = 2\n interpolation = \"uniform\"\n )";
        let expected = ["Error USD_COUNT /m.normals: 1", "Error USD_COUNT /m.primvars:names: 2"];
        assert_eq!(counted(&mesh(POINTS, more)), expected);
    }

    #[test]
    fn arrays_of_splats_are_as_many_as_positions() {
        let all = "quatf[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0), (1, 0, 0, 0)]\n \
                   float3[] scales = [(0.1, 0.1, 0.1), (0.1, 0.1, 0.1), (0.1, 0.1, 0.1)]\n float[] opacities = [1, 1, 1]\n \
                   float3[] radiance:sphericalHarmonicsCoefficients = [(0, 0, 0), (0, 0, 0), (0, 0, 0)]";
        assert_eq!(findings(&splats(all)), Vec::<String>::new());
        assert_eq!(findings(&splats("")), Vec::<String>::new(), "what is absent has defaults");
        let short = all.replacen(", (0, 0, 0)]", "]", 1).replace("[1, 1, 1]", "[1, 1, 1, 1]");
        let expected = ["opacities: 4", "radiance:sphericalHarmonicsCoefficients: 2"];
        assert_eq!(findings(&splats(&short)), expected.map(|what| format!("Error USD_COUNT /s.{what}")));
        let of_degree_1 = splats(all).replace("Degree = 0", "Degree = 1");
        assert_eq!(findings(&of_degree_1), ["Error USD_COUNT /s.radiance:sphericalHarmonicsCoefficients: 3"]);
    }

    #[test]
    fn extents_hold_what_is_there_and_little_more() {
        let extents = |text: String| findings(&text).into_iter().map(|f| f[..f.find(": ").unwrap()].to_owned());
        let of_mesh =
            |extent: &str| extents(mesh(POINTS, &format!("float3[] extent = [{extent}]"))).collect::<Vec<_>>();
        let none = Vec::<String>::new();
        assert_eq!(of_mesh("(0, 0, 0), (1, 1, 0.5)"), none);
        assert_eq!(of_mesh("(-0.00001, 0, 0), (1, 0.99999, 0.5)"), none, "rounded");
        for wrong in ["(0, 0, 0), (1, 1, 0)", "(0, 0, 0), (0, 0, 0)", "(1, 1, 0.5), (0, 0, 0)", "(0, 0, 0)", ""] {
            assert_eq!(of_mesh(wrong), ["Error USD_EXTENT /m.extent"], "{wrong}");
        }
        assert_eq!(of_mesh("(0, 0, 0), (1, 1, 2)"), ["Warning USD_EXTENT /m.extent"]);
        let skinned = mesh(POINTS, "float3[] extent = [(-9, -9, -9), (9, 9, 9)]\n rel skel:skeleton = </s>");
        assert_eq!(findings(&skinned), none, "bones may reach there");
        let of_splats = |extent: &str| {
            let more = "float3[] scales = [(0.1, 0.2, 0.1), (0.1, 0.1, 0.1), (0.1, 0.1, 0.1)]";
            extents(splats(&format!("{more}\n float3[] extent = [{extent}]"))).collect::<Vec<_>>()
        };
        assert_eq!(of_splats("(-0.6, -0.6, -0.6), (1.6, 2.6, 0.6)"), none);
        assert_eq!(of_splats("(0, 0, 0), (1, 1, 0)"), ["Error USD_EXTENT /s.extent"]);
        assert_eq!(of_splats("(-9, -9, -9), (9, 9, 9)"), ["Warning USD_EXTENT /s.extent"]);
        // Each time sample has its own positions.
        let moving = "point3f[] points.timeSamples = { 1: [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], \
                      2: [(0, 0, 5), (1, 0, 5), (1, 1, 5), (0, 1, 5)] }";
        let at_two = |extent: &str| {
            let samples = format!("1: [(0, 0, 0), (1, 1, 0)], 2: [{extent}]");
            extents(mesh(moving, &format!("float3[] extent.timeSamples = {{ {samples} }}"))).collect::<Vec<_>>()
        };
        assert_eq!(at_two("(0, 0, 5), (1, 1, 5)"), none);
        assert_eq!(at_two("(0, 0, 0), (1, 1, 0)"), ["Error USD_EXTENT /m.extent"]);
    }

    #[test]
    fn what_we_write_is_faultless_and_what_readers_stop_at_is_said_once() {
        let folder = tempfile::tempdir().unwrap();
        for (seed, name) in [(1, "a.usda"), (2, "a.usdz")] {
            let path = folder.path().join(name);
            usd::write(&path, &random_scene(40, 2, 2, seed), &[("c".to_owned(), camera())], None).unwrap();
            assert_eq!(validate(&path).unwrap().findings, []);
        }
        // The reader needs a value that is missing.
        let text = "texCoord2f[] primvars:st = [(0, 0)] (interpolation = \"faceVarying\")";
        assert_eq!(findings(&mesh(POINTS, text)), ["Error USD_COUNT /m.primvars:st: 1"]);
        let text = "int[] faceVertexIndices = [0, 1, 9]";
        let found = findings(&mesh(POINTS, "").replace("int[] faceVertexIndices = [0, 1, 2, 0, 2, 3]", text));
        assert_eq!(found, ["Error CONTENT /m.faceVertexIndices: 3"]);
        assert_eq!(findings("def Mesh"), ["Error CONTENT line 2, column 9: the end of the file"]);
    }

    #[test]
    fn maps_that_cannot_be_read_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.usda");
        let (_, files) = usd::write(&path, &random_scene(0, 1, 2, 3), &[], None).unwrap();
        for (map, attribute) in [("base", "baseMap"), ("bands", "bandsMap")] {
            let name = files.iter().find(|name| name.contains(map) && name.ends_with(".exr")).unwrap();
            let file = folder.path().join(name);
            let content = std::fs::read(&file).unwrap();
            for damage in [Some(b"junk"), None] {
                match damage {
                    Some(junk) => std::fs::write(&file, junk).unwrap(),
                    None => std::fs::remove_file(&file).unwrap(),
                }
                let found = validate(&path).unwrap();
                assert_eq!((found.errors, found.findings.len(), found.findings[0].code), (1, 1, "USD_MAP"), "{found}");
                let place = found.findings[0].location.to_string();
                assert!(place.ends_with(&format!(".centaur:{attribute}: ")), "{place}");
            }
            std::fs::write(&file, content).unwrap();
        }
        assert_eq!(validate(&path).unwrap().findings, []);
    }

    #[test]
    fn faults_in_a_package_name_its_member() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.usdz");
        let mut zip = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
        let stored = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
        zip.start_file("scene.usda", stored).unwrap();
        let text = format!("#usda 1.0\n{}", mesh(POINTS, "float3[] extent = [(0, 0, 0), (1, 0, 0)]"));
        zip.write_all(text.as_bytes()).unwrap();
        zip.finish().unwrap();
        let at = Box::new(Location::Pointer("/m.extent".to_owned()));
        let found = validate(&path).unwrap().findings;
        assert_eq!((found.len(), &found[0].location), (1, &Location::Member { name: "`scene.usda`".to_owned(), at }));
    }
}
