"""The packages that this project needs: their licences, hashes, a bill of materials and the NOTICE file."""
