"""Writers: npz, glTF, video, contact sheets."""
